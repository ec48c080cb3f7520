"""Points that are recognised in several frames: SIFT, matched between pairs of frames, verified by their geometry.

D. Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 60(2), 2004; descriptors as square roots
(R. Arandjelović and A. Zisserman, CVPR 2012), so that their products compare distributions. Which pairs are worth
matching is told by a few large features of each frame first (C. Wu, "Towards linear-time incremental structure from
motion", 3DV 2013).
"""

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ipjax.capture.records import CaptureFrame

MOST = 2000  # points of a frame that are described
WEAKEST = 0.015  # contrast of a point, of 1; OpenCV's own is 0.04, which leaves few on plain things
TRIED = 400  # large features of each frame by which pairs are chosen
ALL_PAIRS = 40  # frames up to which every pair may be matched
PARTNERS = 20  # of each frame, beyond that
RATIO = 0.8  # of the distances to the best and the second best descriptor, above which a match may be either
WITHIN = 1.5  # pixels from the epipolar line
FEWEST = 15  # matches that a pair needs
STILL = 1.0  # pixels by which what moves with the camera may move in the image
FAR = 40.0  # pixels by which the rest must have moved, by the median, where that is asked
EDGE = 0.03  # of the depth: a larger step between neighbouring pixels is an edge, at which a point has no depth


@dataclasses.dataclass(frozen=True)
class Features:
    """What is recognised of one frame. A point may have several descriptors, one for each of its directions."""

    pixel: Float[np.ndarray, "n 2"]  # (x, y)
    depth: Float[np.ndarray, " n"]  # along z, metres; 0 = unknown
    descriptor: Float[np.ndarray, "d 128"]  # unit norm, the largest first
    owner: Int[np.ndarray, " d"]  # whose it is: an index of a point

    def __len__(self) -> int:
        return len(self.pixel)


@dataclasses.dataclass(frozen=True)
class Match:
    """What two frames have in common."""

    first: int  # index of a frame
    second: int  # of a later one
    points: Int[np.ndarray, "m 2"]  # indices of points of the first and the second; none twice
    likeness: Float[np.ndarray, " m"]  # cosine of the descriptors

    def __len__(self) -> int:
        return len(self.points)

    def only(self, chosen: Bool[np.ndarray, " m"]) -> "Match":
        """The same with fewer points."""
        return dataclasses.replace(self, points=self.points[chosen], likeness=self.likeness[chosen])


def detect(frame: CaptureFrame, most: int = MOST) -> Features:
    """SIFT of a frame, where it is usable; with the depth that the frame has at each point."""
    import cv2

    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    mask = None if frame.usable.all() else _shrink(frame.usable)
    # OpenCV's own values but for the contrast; and without the precise enlargement points lie a quarter of a pixel off.
    layers, edge, sigma, precise = 3, 10, 1.6, True
    sift = cv2.SIFT.create(most, layers, WEAKEST, edge, sigma, cv2.CV_32F, precise)
    points, descriptors = sift.detectAndCompute(grey, mask)
    if not points:
        empty = np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.float32), np.zeros(0, int)
        return Features(*empty)
    order = np.argsort([-point.size for point in points], kind="stable")
    found = np.array([points[i].pt for i in order], np.float64)
    places, owner = np.unique(np.round(found, 2), axis=0, return_inverse=True)
    descriptors = np.sqrt(np.maximum(descriptors[order], 0))
    descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
    depth = np.zeros(len(places)) if frame.depth is None else sample_depth(frame.depth, places)
    return Features(places, depth, descriptors.astype(np.float32), owner.reshape(-1))


def _shrink(usable: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """A mask for OpenCV, without the border: a descriptor there would see what is not usable."""
    import cv2

    return cv2.erode(usable.astype(np.uint8) * 255, np.ones((9, 9), np.uint8), borderValue=255)


def sample_depth(depth: Float[np.ndarray, "h w"], pixel: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Depth at places between pixels; 0 where fewer than three pixels around are known, or at an edge.

    Linear in both directions where the four pixels around are known, else the mean of those of 5 × 5 that are, the
    nearer the more: images that were warped have holes everywhere.
    """
    height, width = depth.shape
    depth = np.where(np.isfinite(depth), depth, 0)
    padded = np.pad(depth, 2)  # with what is unknown
    inside = np.asarray(((pixel > -0.5) & (pixel < np.array([width, height]) - 0.5)).all(1))
    pixel = np.where(inside[:, None], pixel, 0)
    x, y = np.round(pixel).astype(int).T
    rows, columns = (axis.reshape(-1) for axis in np.mgrid[-2:3, -2:3])
    around = padded[y[:, None] + rows + 2, x[:, None] + columns + 2]
    known = around > 0
    middle = np.ma.median(np.ma.masked_array(around, ~known), axis=1).filled(0)
    near = known & (np.abs(around - middle[:, None]) < EDGE * middle[:, None])
    square = (x[:, None] + columns - pixel[:, :1]) ** 2 + (y[:, None] + rows - pixel[:, 1:]) ** 2
    weight = near * np.exp(-square)
    value = (weight * around).sum(1) / np.maximum(weight.sum(1), 1e-12)
    # The four around.
    corner = np.clip(np.floor(pixel).astype(int), 0, [width - 2, height - 2])
    (x, y), (right, down) = corner.T, (pixel - corner).T
    four = np.stack([depth[y, x], depth[y, x + 1], depth[y + 1, x], depth[y + 1, x + 1]])
    share = np.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down])
    smooth = ((four > 0) & (np.abs(four - middle) < EDGE * middle)).all(0)
    value = np.where(smooth, (share * four).sum(0), value)
    told = inside & (near.sum(1) >= 3) & (near.sum(1) >= 0.8 * known.sum(1))
    return np.where(told, value, 0)


def match(
    features: Sequence[Features],
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    *,
    still: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[list[Match], Bool[np.ndarray, "h w"]]:
    """Match the frames with one another: mutual nearest descriptors, clearly nearer than the second, on one geometry.

    Args:
      features: of each frame.
      K: of all of them; pixels.
      size: of the images: width, height.
      still: leave out what moves with the camera.
      progress: told how many of how many pairs are done.

    Returns:
      The pairs that have enough in common; and where in the image something moves with the camera (`find_still`).
    """
    chosen = choose_pairs(features)
    raw = []
    with ThreadPoolExecutor(2) as pool:
        for found in pool.map(lambda pair: match_pair(features, *pair), chosen):
            raw.append(found)
            if progress is not None:
                progress(len(raw), len(chosen))
        mask = find_still(features, raw, size) if still else np.zeros(size[::-1], bool)
        if mask.any():
            hidden = [look_up(mask, one.pixel) for one in features]
            raw = [m.only(~(hidden[m.first][m.points[:, 0]] | hidden[m.second][m.points[:, 1]])) for m in raw]
        verified = list(pool.map(lambda found: verify(found, features, K), raw))
    return [found for found in verified if len(found) >= FEWEST], mask


def choose_pairs(features: Sequence[Features]) -> list[tuple[int, int]]:
    """Pairs of frames that are likely to see the same: neighbours in time, and those whose large features match."""
    count = len(features)
    tried = TRIED if count <= ALL_PAIRS else max(100, int(TRIED * (ALL_PAIRS / count) ** 0.5))
    large = [one.descriptor[:tried] for one in features]
    votes = np.zeros((count, count), int)
    for i in range(count):
        for j in range(i + 1, count):
            votes[i, j] = votes[j, i] = len(_mutual(large[i], large[j])[0])
    # Of frames that see nothing in common a few descriptors are alike by chance.
    worth = votes >= np.maximum(4, np.median(votes) if count > ALL_PAIRS else 0)
    if count > ALL_PAIRS:
        least = np.sort(votes, axis=1)[:, -PARTNERS][:, None]
        worth &= (votes >= least) | (votes >= least).T
    near = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) <= 2
    first, second = np.nonzero(np.triu(worth | near, 1))
    return list(zip(first.tolist(), second.tolist(), strict=True))


def _mutual(
    one: Float[np.ndarray, "n 128"], other: Float[np.ndarray, "m 128"]
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Pairs of descriptors that are nearest to each other, and clearly so: indices of both, cosines."""
    if len(one) < 2 or len(other) < 2:
        return np.zeros(0, int), np.zeros(0, int), np.zeros(0)
    alike = one @ other.T
    rows = np.arange(len(one))
    best = alike.argmax(1)
    value = alike[rows, best]
    mutual = value >= alike.max(0)[best]
    alike[rows, best] = -1
    clear = 1 - value < RATIO**2 * (1 - alike.max(1))  # of unit vectors: half the squared distances
    kept = mutual & clear
    return rows[kept], best[kept], value[kept]


def match_pair(features: Sequence[Features], first: int, second: int) -> Match:
    """Two frames by their descriptors alone: what is nearest to each other, and clearly so; not verified."""
    one, other = features[first], features[second]
    i, j, value = _mutual(one.descriptor, other.descriptor)
    points = np.stack([one.owner[i], other.owner[j]], axis=1)
    order = np.argsort(-value, kind="stable")
    points, value = points[order], value[order].astype(np.float64)
    # Of a point with several descriptors, the match that is most alike.
    alone = np.zeros(len(points), bool)
    alone[np.unique(points[:, 0], return_index=True)[1]] = True
    again = np.zeros(len(points), bool)
    again[np.unique(points[:, 1], return_index=True)[1]] = True
    return Match(first, second, points, value).only(alone & again)


def verify(found: Match, features: Sequence[Features], K: Float[np.ndarray, "3 3"]) -> Match:
    """The matches that one motion of the camera explains: within `WITHIN` of the epipolar line."""
    import cv2

    if len(found) < FEWEST:
        return found.only(np.zeros(len(found), bool))
    one, other = features[found.first].pixel[found.points[:, 0]], features[found.second].pixel[found.points[:, 1]]
    try:
        matrix, inside = cv2.findEssentialMat(one, other, K, cv2.USAC_MAGSAC, 0.9999, WITHIN, 2000)
    except cv2.error:  # of points that no motion explains
        return found.only(np.zeros(len(found), bool))
    if matrix is None or inside is None:
        return found.only(np.zeros(len(found), bool))
    return found.only(inside.reshape(-1).astype(bool))


def find_still(
    features: Sequence[Features], matches: Sequence[Match], size: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    """Where in the image something moves with the camera (a gripper, a hand): it stays while the scene moves on.

    Only pairs of frames count in which much else has moved far. Of a camera that circles about a point the
    neighbourhood of that point stays, too, but it is as small as `STILL` over the turn between such frames; what is
    found is larger.

    Args:
      features: of each frame.
      matches: of descriptors alone, not verified.
      size: of the images: width, height.

    Returns:
      True where it is, with a margin; nowhere for most captures.
    """
    import cv2
    from scipy import ndimage

    width, height = size
    seen: dict[int, list[np.ndarray]] = {}  # of each frame, the pixels of points that stayed
    for found in matches:
        first = features[found.first].pixel[found.points[:, 0]]
        second = features[found.second].pixel[found.points[:, 1]]
        moved = np.linalg.norm(second - first, axis=1)
        others = moved > 5 * STILL
        if others.sum() < FEWEST or np.median(moved[others]) < FAR or others.mean() < 0.2:
            continue
        stayed = moved < STILL
        if stayed.sum() >= 3:
            seen.setdefault(found.first, []).append(first[stayed])
            seen.setdefault(found.second, []).append(second[stayed])
    votes = np.zeros((height, width), int)
    for pixels in seen.values():
        x, y = np.round(np.concatenate(pixels)).astype(int).T
        here = np.zeros((height, width), bool)
        here[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)] = True
        votes += np.asarray(ndimage.binary_dilation(here, iterations=4))
    # Padded, so that what reaches the border stays there; closed, because between its points it is there, too.
    seen_often = np.pad(votes >= max(3, 0.2 * len(features)), 24)
    closed = np.asarray(ndimage.binary_closing(seen_often, iterations=24))[24:-24, 24:-24]
    _, labels = cv2.connectedComponents(closed.astype(np.uint8), connectivity=4)
    mask = np.zeros((height, width), bool)
    for index, (rows, columns) in enumerate(ndimage.find_objects(labels), start=1):
        if max(rows.stop - rows.start, columns.stop - columns.start) >= 30:
            mask |= labels == index
    return np.asarray(ndimage.binary_dilation(mask, iterations=10)) if mask.any() else mask


def look_up(mask: Bool[np.ndarray, "h w"], pixel: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """What a mask has at the nearest pixels."""
    x, y = np.round(pixel).astype(int).T
    return mask[np.clip(y, 0, mask.shape[0] - 1), np.clip(x, 0, mask.shape[1] - 1)]
