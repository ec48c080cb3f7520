"""Runs ``ipjax`` or ``python -m benchmarks.evaluation`` with the stand-in encoder of `problems`; started by tests.

Arguments: seconds that each image takes longer (so that there is time to be killed in), then "ipjax" or "benchmark",
then the command's own. The folder above must be on the path.
"""

import sys
import time

import equinox as eqx

from benchmarks import evaluation
from ipjax import cli
from ipjax.bop import run as studies
from ipjax.commands.interface import options
from ipjax.synthetic.problems import CoordinateEncoder, make_encoder


class Named(CoordinateEncoder):
    """The encoder with an identity, as object files want it."""

    identity: str = eqx.field(static=True, default="coordinates")


plain = make_encoder()
encoder = Named(plain.frequencies, plain.phases)
options.load_encoder = lambda arguments: encoder
evaluation.load_encoder = lambda *_, **__: encoder
estimate = studies.Finder.__call__


def slowly(finder, frame, targets):
    time.sleep(float(sys.argv[1]))
    return estimate(finder, frame, targets)


studies.Finder.__call__ = slowly
if sys.argv[2] == "ipjax":
    sys.exit(cli.main(sys.argv[3:]))

made: list[studies.Finder] = []
beside = studies.Finder.beside
studies.Finder.beside = lambda finder, config: (made.append(beside(finder, config)), made[-1])[1]
evaluation.main(sys.argv[3:])
print("shared:", all(finder.shared_seconds > 0 for finder in made), len(made))
