"""A gripper's hand in its closing frame, and the poses of hands about a closing axis.

The closing frame has the gripper's origin; u runs along the closing axis, w along the approach, v across both.
"""

import itertools

import jax.numpy as jnp
import numpy as np
from ipjax_kernels.closing import Hand
from ipjax_kernels.positive import root
from jaxtyping import Array, Float

from ipjax.robot.records import Gripper
from ipjax.transforms import Similarity, rotation_from_vector

# Rows: u, v and w in the gripper's axes; a rotation, so that no hand is mirrored.
_CLOSING_FROM_GRIPPER = {"x": np.eye(3), "y": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])}


def closing_from_gripper(closing: str) -> Float[np.ndarray, "3 3"]:
    """The rotation to the closing frame of a gripper whose fingers close along this axis, x or y."""
    return _CLOSING_FROM_GRIPPER[closing]


def make_hand(gripper: Gripper, dtype) -> Hand:
    """The hand, open, in its closing frame."""
    number = lambda x: jnp.asarray(x, dtype)
    turn = np.abs(closing_from_gripper(gripper.closing)).astype(dtype)
    signed = closing_from_gripper(gripper.closing).astype(dtype)
    rows = lambda values: jnp.stack([jnp.stack([number(x) for x in row]) for row in values])
    if gripper.boxes:
        centres = jnp.matmul(rows([c for c, _ in gripper.boxes]), signed.T, precision="highest")
        halves = jnp.matmul(rows([h for _, h in gripper.boxes]), turn.T, precision="highest")
    else:
        centres = halves = jnp.zeros((0, 3), dtype)
    return Hand(
        opening=number(gripper.opening),
        thickness=number(gripper.finger[1]),
        breadth=number(gripper.pad[1]),
        root=number(gripper.tip - gripper.finger[0]),
        pad=number(gripper.tip - gripper.pad[0]),
        tip=number(gripper.tip),
        low=centres - halves,
        high=centres + halves,
    )


def hand_corners(hand: Hand) -> Float[Array, "c 3"]:
    """The corners of the open hand's boxes, fingers first, closing frame: the hand lies within their hull."""
    low, high = hand_boxes(hand)
    picks = np.array(list(itertools.product((0, 1), repeat=3)))  # which end of each axis
    both = jnp.stack([low, high])  # 2 k 3
    return jnp.stack([both[picks[:, a], :, a] for a in range(3)], axis=-1).reshape(-1, 3)


def hand_boxes(hand: Hand) -> tuple[Float[Array, "k 3"], Float[Array, "k 3"]]:
    """Lowest and highest corners of the two open fingers and of the body's boxes, closing frame."""
    half, out = hand.opening / 2, hand.opening / 2 + hand.thickness
    side = hand.breadth / 2
    left = jnp.stack([-out, -side, hand.root]), jnp.stack([-half, side, hand.tip])
    right = jnp.stack([half, -side, hand.root]), jnp.stack([out, side, hand.tip])
    fingers = [jnp.stack([left[i], right[i]]) for i in range(2)]
    return jnp.concatenate([fingers[0], hand.low]), jnp.concatenate([fingers[1], hand.high])


def fan(
    middle: Float[Array, "p 3"], axis: Float[Array, "p 3"], wanted: Float[Array, "3"], hand: Hand, count: int
) -> Similarity:
    """Hands that close along ``axis``, the middle of their pads at ``middle``, from ``count`` sides evenly around it.

    The first of each comes as nearly along ``wanted`` as the axis lets it.

    Returns:
      ``object_from_closing``, leading axes p and count, scale 1.
    """
    approach = wanted - axis * jnp.sum(axis * wanted, axis=-1, keepdims=True)
    other = jnp.eye(3, dtype=axis.dtype)[jnp.argmin(jnp.abs(axis), axis=-1)]  # for an axis along the wanted approach
    other = jnp.cross(axis, other)
    steep = jnp.sum(approach**2, axis=-1, keepdims=True) > 1e-4
    approach = jnp.where(steep, approach, other)
    approach = approach / root(jnp.sum(approach**2, axis=-1, keepdims=True))
    angles = jnp.asarray(np.arange(count) * (2 * np.pi / count), axis.dtype)
    turns = rotation_from_vector(axis[:, None] * angles[None, :, None])
    approach = jnp.sum(turns * approach[:, None, None, :], axis=-1)
    closing = jnp.broadcast_to(axis[:, None], approach.shape)
    rotation = jnp.stack([closing, jnp.cross(approach, closing), approach], axis=-1)
    place = middle[:, None] - approach * (hand.pad + hand.tip) / 2
    return Similarity(rotation, place, jnp.ones(place.shape[:-1], axis.dtype))
