"""The slow twins: every kernel as the obvious NumPy loop, in float64. The oracle of the tests; nothing else uses it."""

import math

import numpy as np


def nearest(query, templates, query_valid, template_valid, missing=-2.0):
    """``neighbours.nearest``: a maximum over a list of candidates, one patch at a time. Returns the same four."""
    query, templates = np.asarray(query, np.float64), np.asarray(templates, np.float64)
    views, others = templates.shape[:2]
    patches = len(query)
    forth, back = np.zeros((views, patches), np.int32), np.zeros((views, others), np.int32)
    forth_similarity, back_similarity = np.full(forth.shape, missing), np.full(back.shape, missing)
    for v in range(views):
        for i in np.flatnonzero(query_valid):
            candidates = [(float(query[i] @ templates[v, j]), -int(j)) for j in np.flatnonzero(template_valid[v])]
            if candidates:
                forth_similarity[v, i], forth[v, i] = max(candidates)
        for j in np.flatnonzero(template_valid[v]):
            candidates = [(float(query[i] @ templates[v, j]), -int(i)) for i in np.flatnonzero(query_valid)]
            if candidates:
                back_similarity[v, j], back[v, j] = max(candidates)
    return -forth, forth_similarity, -back, back_similarity


def cycle_distance(query_to_template, template_to_query, grid, query_valid, template_valid):
    """``neighbours.cycle_distance`` (Eq. 4)."""
    distance = np.full(len(query_valid), np.inf)
    for i in np.flatnonzero(query_valid):
        j = query_to_template[i]
        if template_valid[j]:
            distance[i] = math.dist(grid[i], grid[template_to_query[j]])
    return distance


def umeyama(source, target, weight, with_scale=True):
    """``similarity.umeyama`` of one set, through NumPy's SVD. Returns rotation, translation, scale."""
    source, target, weight = (np.asarray(x, np.float64) for x in (source, target, weight))
    weight = weight / weight.sum()
    source_mean, target_mean = weight @ source, weight @ target
    source, target = source - source_mean, target - target_mean
    u, s, vt = np.linalg.svd((weight[:, None] * target).T @ source)
    d = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(d) @ vt
    scale = (s * d).sum() / (weight @ (source**2).sum(axis=1)) if with_scale else 1.0
    return rotation, target_mean - scale * rotation @ source_mean, scale


def draw_minimal_sets(generator, weight, count, size):
    """``consensus.draw_minimal_sets``: NumPy's own choice without replacement, one set at a time."""
    weight = np.asarray(weight, np.float64)
    return np.stack([generator.choice(len(weight), size, replace=False, p=weight / weight.sum()) for _ in range(count)])


def consensus(source, target, weight, threshold, sets, refits=0, rank="msac", relative=False):
    """``consensus.consensus`` without its gates: the best hypothesis as (rotation, translation, scale, score, inliers).

    One set after another, one pair after another.
    """
    source, target, weight = (np.asarray(x, np.float64) for x in (source, target, weight))

    def judge(rotation, translation, scale):
        limit = threshold * scale if relative else threshold
        distances = [math.dist(scale * rotation @ x + translation, y) for x, y in zip(source, target, strict=True)]
        inliers = np.array([distance < limit for distance in distances])
        loss = sum(w * distance**2 for w, distance in zip(weight, distances, strict=True))
        if rank == "count":
            return weight[inliers].sum() / weight.sum(), -loss, inliers
        terms = [w * max(0.0, 1 - (distance / limit) ** 2) for w, distance in zip(weight, distances, strict=True)]
        return sum(terms) / weight.sum(), 0.0, inliers

    best, best_rank = None, (-1.0, 0.0)
    for chosen in sets:
        similarity = umeyama(source[chosen], target[chosen], np.ones(len(chosen)))
        score, tie, inliers = judge(*similarity)
        if (score, tie) > best_rank:
            best, best_rank = (*similarity, score, inliers), (score, tie)
    if best is None:
        raise ValueError("no sets")
    for _ in range(refits):
        similarity = umeyama(source, target, weight * best[4])
        score, tie, inliers = judge(*similarity)
        if (score, tie) > best_rank:
            best, best_rank = (*similarity, score, inliers), (score, tie)
    return best


def resection_loss(rotation, translation, points, rays, weight, width):
    """The root of each pair's weighted Geman–McClure loss of its ray, [k]: half their squares' sum is half the loss."""
    placed = points @ np.asarray(rotation).T + translation
    squared = np.sum((placed[:, :2] / placed[:, 2:] - rays) ** 2, axis=1) / width**2
    return np.sqrt(np.where(placed[:, 2] > 0, squared / (1 + squared), 1) * weight / np.sum(weight))


def direct_loss(rotation, translation, points, picture, facing=0.2):
    """The loss of ``direct.align_directly`` at a pose, one point after another."""
    rotation, translation = np.asarray(rotation, np.float64), np.asarray(translation, np.float64)
    values, colours = np.asarray(picture.values, np.float64), np.asarray(points.colours, np.float64)
    height, width = values.shape[:2]
    total = counted = 0.0
    for k in np.flatnonzero(points.weight):
        place = rotation @ np.asarray(points.places[k], np.float64) + translation
        normal = rotation @ np.asarray(points.normals[k], np.float64)
        if place[2] <= 0 or -(normal @ place) <= facing * np.linalg.norm(place):
            continue
        x, y = np.asarray(picture.focal) * place[:2] / place[2] + np.asarray(picture.centre)
        x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
        column, row = min(int(x), width - 2), min(int(y), height - 2)
        a, b = x - column, y - row
        above = values[row, column] * (1 - a) + values[row, column + 1] * a
        below = values[row + 1, column] * (1 - a) + values[row + 1, column + 1] * a
        seen = above * (1 - b) + below * b
        squared = np.sum((seen[: colours.shape[1]] - colours[k]) ** 2)
        total += points.weight[k] * (squared / (1 + squared) if seen[-1] > 0.99 else 1.0)
        counted += points.weight[k]
    return total / counted if counted else 1.0
