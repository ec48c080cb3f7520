"""The obvious NumPy loops for `trajectory`: the oracle of the tests."""

import numpy as np


def fit_planes(inverse, focal, centre, jump, shrink=1, radius=2):
    """A least-squares plane in inverse depth around every block. Returns inverse depths, normals."""
    inverse = np.asarray(inverse, np.float64)
    height, width = inverse.shape[0] // shrink, inverse.shape[1] // shrink
    blocks = {}
    for row in range(height):
        for column in range(width):
            kept = []
            for y in range(shrink):
                for x in range(shrink):
                    value = inverse[row * shrink + y, column * shrink + x]
                    place = [column + (x - (shrink - 1) / 2) / shrink, row + (y - (shrink - 1) / 2) / shrink, value]
                    kept += [place] if value > 0 else []
            nearest = max((place[2] for place in kept), default=0)
            blocks[row, column] = [place for place in kept if place[2] > (1 - jump) * nearest]
    planes, normals = np.zeros((height, width)), np.zeros((height, width, 3))
    even = radius * (radius + 1) / 3
    for (row, column), own in blocks.items():
        if not own:
            continue
        mean, places = np.mean([place[2] for place in own]), []
        for y in range(row - radius, row + radius + 1):
            for x in range(column - radius, column + radius + 1):
                other = blocks.get((y, x), [])
                if other and abs(np.mean([place[2] for place in other]) - mean) < radius * jump * mean:
                    places += other
        x, y, w = np.array(places).T
        x, y = x - column, y - row
        spread = np.cov(np.stack([x, y]), bias=True) if len(x) > 1 else np.zeros((2, 2))
        if len(x) < 6 or np.linalg.det(spread) <= 0.1 * even**2 or x.mean() ** 2 + y.mean() ** 2 >= even:
            continue
        slope_x, slope_y, here = np.linalg.lstsq(np.stack([x, y, np.ones_like(x)], 1), w, rcond=None)[0]
        ahead = here + slope_x * (centre[0] - column) + slope_y * (centre[1] - row)
        normal = -np.array([slope_x * focal[0], slope_y * focal[1], ahead])
        if here > 0:
            planes[row, column], normals[row, column] = here, normal / np.linalg.norm(normal)
    return planes, normals


def compare_pair(places, normals, brightness, there, image, focal, centre, rotation, translation, gates, colours=False):
    """``trajectory.compare_pairs`` of one pair, point by point. Returns a dictionary of its fields."""
    height, width = image.shape[:2]
    found = {"hessian": np.zeros((6, 6)), "slope": np.zeros(6), "shared": np.zeros((6, 6)), "loss": 0.0}
    count, errors = 0, []
    for place, normal, light, known in zip(places, normals, brightness, there, strict=True):
        moved, own = rotation @ place + translation, rotation @ normal
        if not known or moved[2] <= 1e-3:
            continue
        ray = moved / moved[2]
        u, v = focal * ray[:2] + centre
        if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
            continue
        column, row = min(int(u), width - 2), min(int(v), height - 2)
        x, y = u - column, v - row
        corners = image[row : row + 2, column : column + 2]
        low, high = corners[..., 0].min(), corners[..., 0].max()
        if low <= 0 or high - low >= gates.jump * high or -own @ ray <= gates.facing * np.linalg.norm(ray):
            continue
        shares = np.array([[(1 - x) * (1 - y), x * (1 - y)], [(1 - x) * y, x * y]])
        between = (shares[..., None] * corners).sum((0, 1))
        if np.linalg.norm(between[1:4]) <= 0.5:
            continue
        count += 1
        other = between[1:4] / np.linalg.norm(between[1:4])
        if own @ other <= gates.alike:
            found["loss"] += gates.width**2
            continue
        seen = 1 / between[0]
        residual = other @ moved - other @ (seen * ray)
        noise = lambda z: gates.noise * (1 + gates.growth * z**2)
        variance = max((other @ ray) ** 2, 0.1) * noise(seen) ** 2
        variance += max((own @ ray) ** 2, 0.1) * noise(place[2]) ** 2
        squared = residual**2 / (variance * gates.width**2)
        weight = 1 / (variance * (1 + squared) ** 2)
        lever = np.concatenate([np.cross(moved, other), other])
        mine = np.concatenate([np.cross(moved, own), own])
        found["hessian"] += weight * np.outer(lever, lever)
        found["shared"] += weight * (np.outer(lever, mine) + np.outer(mine, lever)) / 2
        found["slope"] += weight * residual * lever
        found["loss"] += gates.width**2 * squared / (1 + squared)
        if squared >= 1:
            continue
        errors.append(abs(residual) / np.sqrt(variance))
        if colours:
            across = (corners[0, 1, 4] - corners[0, 0, 4]) * (1 - y) + (corners[1, 1, 4] - corners[1, 0, 4]) * y
            down = (corners[1, 0, 4] - corners[0, 0, 4]) * (1 - x) + (corners[1, 1, 4] - corners[0, 1, 4]) * x
            by_pixel = np.array([[focal[0], 0, -focal[0] * ray[0]], [0, focal[1], -focal[1] * ray[1]]]) / moved[2]
            ramp = np.array([across, down]) @ by_pixel
            lever = np.concatenate([np.cross(moved, ramp), ramp])
            unlike = between[4] - light
            weight = 1 / (gates.contrast**2 * (1 + unlike**2 / (9 * gates.contrast**2)) ** 2)
            for name in ("hessian", "shared"):
                found[name] += weight * np.outer(lever, lever)
            found["slope"] += weight * unlike * lever
    return found | {"compared": count, "near": len(errors), "spread": np.mean(errors) if errors else 0.0}
