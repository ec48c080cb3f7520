"""The obvious NumPy loops for `views.draw_view`: the oracle of the tests."""

import numpy as np


def draw_view(sources, rules, focal, centre, height, width):
    """One pixel after another, in float64. Returns colours, depth and support."""
    colours, depths, rotations, translations, weights, own_focal, own_centre = (
        np.asarray(part, np.float64) for part in sources
    )
    tolerance, turn, edge = (float(rule) for rule in rules)
    focal, centre = np.asarray(focal, np.float64), np.asarray(centre, np.float64)
    count, rows, columns = depths.shape
    guesses = []
    for k in np.flatnonzero(weights > 0):
        pose = rotations[k], translations[k]
        guesses += [(k, g) for g in _carry(depths[k], *pose, own_focal, own_centre, focal, centre, height, width)]
    image, drawn, support = np.zeros((height, width, 3)), np.zeros((height, width)), np.zeros((height, width))
    for row in range(height):
        for column in range(width):
            ray = np.array([*((np.array([column, row]) - centre) / focal), 1.0])

            def look(depth, ray=ray):
                """Of every source: its pixel, weight, agreement, whether it sees through, and where the ray meets it;
                None where it says nothing.
                """
                found = []
                point = depth * ray
                for k in range(count):
                    moved = rotations[k] @ point + translations[k]
                    if moved[2] <= 1e-3:
                        found.append(None)
                        continue
                    pixel = own_focal * moved[:2] / moved[2] + own_centre
                    if not (-0.5 <= pixel[0] <= columns - 0.5 and -0.5 <= pixel[1] <= rows - 0.5):
                        found.append(None)
                        continue
                    pixel = np.clip(pixel, 0, [columns - 1, rows - 1])
                    measured = _between_alike(depths[k], pixel, tolerance)
                    if measured <= 0:
                        found.append(None)
                        continue
                    off = (measured - moved[2]) / (tolerance * moved[2])
                    back = -rotations[k].T @ translations[k] - point
                    cosine = -(back @ point) / max(np.linalg.norm(back) * np.linalg.norm(point), 1e-9)
                    weight = weights[k] / (1 + 2 * max(1 - cosine, 0) / turn**2) ** 2
                    weight /= max(moved[2] * focal.mean() / (own_focal.mean() * depth), 1) ** 2
                    slope = rotations[k, 2] @ ray
                    meets = depth if abs(slope) < 0.05 else (measured - translations[k, 2]) / slope
                    found.append((pixel, weight, max(1 - off**2, 0), off > 1, meets))
                return found

            depth = score = 0.0
            for k, carried in guesses:
                guess = carried[row, column]
                if guess <= 0:
                    continue
                for _ in range(2):
                    own = look(guess)[k]
                    guess = guess if own is None or guess <= 0 else own[4]
                if guess <= 0:
                    continue
                total = sum(one[1] * (one[2] - one[3]) for one in look(guess) if one is not None)
                slack = tolerance * depth
                nearer = depth == 0 or guess < depth - slack or (guess <= depth + slack and total > score)
                if total > 0 and nearer:
                    depth, score = guess, total
            if depth == 0:
                continue
            for _ in range(2):
                seen = [one for one in look(depth) if one is not None]
                total = sum(one[1] * one[2] for one in seen)
                if total > 0:
                    depth = sum(one[1] * one[2] * one[4] for one in seen) / total
            total, colour = 0.0, np.zeros(3)
            for k, one in enumerate(look(depth)):
                if one is None:
                    continue
                x, y = np.round(one[0]).astype(int)
                weight = one[1] * one[2] * (edge if _is_beside_jump(depths[k], y, x, tolerance) else 1)
                total += weight
                colour += weight * _between(colours[k], one[0])
            if total > 0:
                image[row, column], drawn[row, column], support[row, column] = colour / total, depth, total
    return image, drawn, support


def _carry(depth, rotation, translation, own_focal, own_centre, focal, centre, height, width):
    points = []
    for row, column in zip(*np.nonzero(depth > 0), strict=True):
        ray = np.array([*((np.array([column, row]) - own_centre) / own_focal), 1.0])
        points.append(rotation.T @ (depth[row, column] * ray - translation))
    own, around = (_splat(points, focal, centre, height, width, radius) for radius in (0, 1))
    coarse = _splat(points, focal / 2, centre / 2, (height + 1) // 2 + 1, (width + 1) // 2 + 1, 1)
    for row, column in zip(*np.nonzero(around == 0), strict=True):
        around[row, column] = coarse[(row + 1) // 2, (column + 1) // 2]
    return own, around


def _splat(points, focal, centre, height, width, radius):
    """The nearest of the points in the pixels around each."""
    image = np.full((height, width), np.inf)
    for point in points:
        if point[2] > 0:
            column, row = np.round(focal * point[:2] / point[2] + centre).astype(int)
            for i in range(max(row - radius, 0), min(row + radius + 1, height)):
                for j in range(max(column - radius, 0), min(column + radius + 1, width)):
                    image[i, j] = min(image[i, j], point[2])
    return np.where(np.isfinite(image), image, 0)


def _corners(pixel, height, width):
    column, row = int(np.clip(np.floor(pixel[0]), 0, width - 2)), int(np.clip(np.floor(pixel[1]), 0, height - 2))
    x, y = pixel[0] - column, pixel[1] - row
    places = [(row, column), (row, column + 1), (row + 1, column), (row + 1, column + 1)]
    return places, [(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]


def _between(image, pixel):
    places, weights = _corners(pixel, *image.shape[:2])
    return sum(weight * image[place] for place, weight in zip(places, weights, strict=True))


def _between_alike(depth, pixel, tolerance):
    places, weights = _corners(pixel, *depth.shape)
    four = [depth[place] for place in places]
    if min(four) > 0 and max(four) - min(four) <= 3 * tolerance * min(four):
        return sum(weight * z for weight, z in zip(weights, four, strict=True))
    return four[int(np.argmax(weights))]


def _is_beside_jump(depth, row, column, tolerance):
    window = depth[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
    known = window[window > 0]
    return depth[row, column] > 0 and window.max() - known.min() > 2 * tolerance * depth[row, column]
