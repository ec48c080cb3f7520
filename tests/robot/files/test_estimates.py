"""An estimate that was written is read back as far as planning needs it."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from builders.estimates import make_estimate
from builders.objects import make_object

from ipjax.files.storage.writing import write_text
from ipjax.inference.reports import estimate_as_json, to_json
from ipjax.records import Hypotheses, Similarity
from ipjax.robot.files.estimates import read_estimate
from ipjax.transforms import rotation_from_vector


def test_round_trip(tmp_path):
    templates, info = make_object()
    templates = dataclasses.replace(templates, extents=jnp.asarray([0.5, 0.6, 0.7]))
    turns = rotation_from_vector(jnp.asarray([[0.1, 0.2, 0.3], [0.1, 0.2, 1.3], [2.0, 0.2, 0.3]], jnp.float32))
    places = jnp.asarray([[0.1, 0.2, 0.9], [0.1, 0.21, 0.9], [0.1, 0.2, 1.0]])
    many = Similarity(turns, places, jnp.asarray([0.15, 0.16, 0.14]))
    given = make_estimate(many.take(0), turn=0.4)
    given = dataclasses.replace(given, hypotheses=Hypotheses(many, jnp.asarray([0.6, 0.5, 0.2])))
    path = tmp_path / "pose.json"
    entry = estimate_as_json(given, templates, info)
    write_text(path, to_json({"frames": [{"frame": "a", "objects": [entry]}, {"frame": "b", "objects": []}]}))
    found = read_estimate(path, templates, info, frame="a")
    close = lambda mine, theirs: np.testing.assert_allclose(np.asarray(mine), np.asarray(theirs), atol=2e-6)
    for name in ("confidence", "covariance", "scale_std", "ambiguity", "diameter"):
        close(getattr(found, name), getattr(given, name))
    close(found.camera_from_object.to_matrix(), many.take(0).to_matrix())
    close(found.box, [[-0.25, -0.3, -0.35], [0.25, 0.3, 0.35]])
    # The alternatives, the answer first, filled up to as many as a file can have.
    close(found.hypotheses.score, [0.6, 0.5, 0.2, -1, -1])
    close(found.hypotheses.camera_from_object.to_matrix()[:3], many.to_matrix())
    # A file without the score of the answer: its alternatives count as if they were as good.
    write_text(
        path, to_json({"frames": [{"frame": "a", "objects": [{k: v for k, v in entry.items() if k != "score"}]}]})
    )
    close(read_estimate(path, templates, info).hypotheses.score[0], 0.5)
