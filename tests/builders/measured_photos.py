"""Objects from one exact photo with depth; the encoder is the stand-in that knows what it sees from its colours."""

import functools

import numpy as np

from ipjax.config import OnboardConfig
from ipjax.onboarding.foreground import Photo
from ipjax.onboarding.photo import onboard_photo
from ipjax.synthetic import problems

ONBOARD = OnboardConfig(directions=8, rolls=1, resolution=112, surface=512, appearance=2048)


@functools.cache
def photograph(seed):
    """The object, and the frame that it was made from."""
    whole = problems.make_frame(seed)
    made = onboard_photo(
        Photo(np.asarray(whole.rgb)), problems.make_encoder(), ONBOARD, mask=whole.mask, depth=np.asarray(whole.depth),
        camera=whole.matrix, progress=False,
    )  # fmt: skip
    return made, whole
