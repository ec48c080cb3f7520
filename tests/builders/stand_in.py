"""Runs ``ipjax`` or ``python -m benchmarks.evaluation`` with the stand-in encoder of `problems`; started by tests.

Arguments: seconds that each image takes longer (so that there is time to be killed in), then "ipjax" or "benchmark",
then the command's own. The folder above must be on the path.
"""

import sys
import time

import equinox as eqx

from benchmarks import evaluation
from ipjax import cli
from ipjax.bop.estimator import DatasetEstimator
from ipjax.commands.interface import options
from ipjax.synthetic.problems import CoordinateEncoder, make_encoder


class Named(CoordinateEncoder):
    """The encoder with an identity, as object files want it."""

    identity: str = eqx.field(static=True, default="coordinates")


plain = make_encoder()
encoder = Named(plain.frequencies, plain.phases)
options.load_encoder = lambda arguments: encoder
evaluation.load_encoder = lambda *_, **__: encoder
estimate = DatasetEstimator.__call__


def slowly(estimator, frame, targets):
    time.sleep(float(sys.argv[1]))
    return estimate(estimator, frame, targets)


DatasetEstimator.__call__ = slowly
if sys.argv[2] == "ipjax":
    sys.exit(cli.main(sys.argv[3:]))

made: list[DatasetEstimator] = []
with_config = DatasetEstimator.with_config
DatasetEstimator.with_config = lambda first, config: (made.append(with_config(first, config)), made[-1])[1]
evaluation.main(sys.argv[3:])
print("shared:", all(estimator.shared_seconds > 0 for estimator in made), len(made))
