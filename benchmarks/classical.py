"""``python -m benchmarks.classical DATA -o FOLDER``: what geometry alone finds, given the object's true size.

The classical baseline of the results page: Fast Point Feature Histograms (Rusu et al., ICRA 2009), RANSAC over triples
of their matches, and point-to-plane ICP, all Open3D's (`pip install open3d`, needed by nothing else), on the masks that
ipjax is given. It is told the true scale, which ipjax has to find. Radii are Open3D's usual multiples of a voxel,
which is 3 % of the object's diameter. Writes what ``ipjax evaluate`` writes; ``ipjax score`` scores the CSV.
"""

import argparse
import dataclasses
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax import cameras
from ipjax.bop.alignments import read_alignment
from ipjax.bop.dataset import Dataset
from ipjax.bop.evaluation import evaluate
from ipjax.bop.objects import OWN_MAP, parse_numbered
from ipjax.bop.records import MM, Estimate, Frame, Target
from ipjax.bop.scoring.tables import format_score
from ipjax.files.meshes.loading import load_mesh
from ipjax.files.meshes.mesh import Mesh
from ipjax.files.weights.hashes import hash_file
from ipjax.synthetic.degradation import degrade
from ipjax.transforms import Similarity

INSTALL = "the classical baseline needs Open3D: pip install open3d"


@dataclasses.dataclass(frozen=True)
class Settings:
    """All lengths in voxels, as in Open3D's own tutorial of global registration."""

    voxel: float = 0.03  # of the object's diameter; a twentieth finds less, and is five times as fast
    samples: int = 20000  # points of the mesh's surface
    normal_radius: float = 2.0
    feature_radius: float = 5.0
    inlier: float = 1.5
    iterations: int = 100_000
    confidence: float = 0.999
    icp_steps: int = 60
    icp_reach: tuple[float, ...] = (4.0, 1.5)  # from coarse to fine


@dataclasses.dataclass(frozen=True)
class Body:
    """An object's mesh and its true size."""

    mesh: Mesh
    metres: float  # per unit of the mesh
    source: str  # the file's sha256
    model_from_mesh: Similarity[np.ndarray] | None = None  # None: the mesh is in the annotated model's frame
    aligned_by: str = ""  # where that comes from


def import_open3d() -> Any:
    """Open3D on one thread; SystemExit with what to install where it is not there.

    Its RANSAC stops when the threads have found enough: with several of them the answer depends on which came first. It
    reads the number once, when it is loaded.
    """
    if "open3d" in sys.modules:
        return sys.modules["open3d"]
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        import open3d
    except ModuleNotFoundError:
        raise SystemExit(INSTALL) from None
    except (ImportError, OSError) as error:  # on a bare system libusb-1.0 and libGL are not there
        raise SystemExit(f"Open3D is installed but a system library that it needs does not load: {error}") from None
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before
    return open3d


def read_bodies(
    dataset: Dataset,
    *,
    objects: Iterable[int] | None = None,
    quality: int = 0,
    seed: int = 0,
    meshes: Mapping[int, Path] | None = None,
    alignments: Mapping[int, Path] | None = None,
) -> dict[int, Body]:
    """The meshes that `ipjax.bop.objects.prepare_objects` onboards, with the scale that it keeps from the method."""
    wanted = {row.obj_id for row in dataset.targets}
    wanted = sorted(wanted if objects is None else wanted & set(objects))
    found = {}
    for obj_id in wanted:
        own = (meshes or {}).get(obj_id)
        path = Path(own) if own is not None else dataset.model_path(obj_id, "models")
        mesh, source = load_mesh(path), hash_file(path)
        if own is not None:
            aligned = Path((alignments or {})[obj_id])
            model_from_mesh = read_alignment(aligned)
            found[obj_id] = Body(mesh, float(model_from_mesh.scale), source, model_from_mesh, aligned.name)
        elif quality:
            mesh, back = degrade(mesh, quality, seed)
            model_from_mesh = Similarity(back.rotation, back.translation * MM, np.asarray(back.scale * MM))
            found[obj_id] = Body(mesh, float(model_from_mesh.scale), source, model_from_mesh, OWN_MAP)
        else:
            found[obj_id] = Body(mesh, MM, source)
    return found


class Classical:
    """An estimator for `ipjax.bop.evaluation.evaluate`."""

    def __init__(self, bodies: Mapping[int, Body], settings: Settings = Settings(), *, seed: int = 0):
        self.open3d = import_open3d()
        self.bodies, self.options, self.seed = dict(bodies), settings, seed
        self.refused: list[str] = []
        self.notes = ["the method was told each object's true size"]
        self.open3d.utility.set_verbosity_level(self.open3d.utility.VerbosityLevel.Error)  # one warning per target
        self._models: dict[int, tuple[Any, Any, float]] = {}

    @property
    def alignments(self) -> dict[int, Similarity[np.ndarray]]:
        """``model_from_mesh`` of the bodies that have one."""
        return {o: b.model_from_mesh for o, b in self.bodies.items() if b.model_from_mesh is not None}

    @property
    def aligned_by(self) -> dict[int, str]:
        """Where each comes from."""
        return {o: self.bodies[o].aligned_by for o in self.alignments}

    def settings(self) -> dict[str, Any]:
        """What the results depend on, as plain JSON."""
        return {
            "method": "FPFH, RANSAC, ICP, given the true scale",
            "open3d": self.open3d.__version__,
            "code": hash_file(Path(__file__))[:12],
            "seed": self.seed,
            **dataclasses.asdict(self.options),
            "objects": {
                str(o): {"mesh": b.source, "notes": list(b.mesh.notes), "metres": b.metres}
                for o, b in sorted(self.bodies.items())
            },
        }

    def __call__(self, frame: Frame, targets: Sequence[Target]) -> list[Estimate]:
        found = []
        for target in targets:
            if target.obj_id not in self.bodies or frame.depth is None:
                continue
            points = unproject(frame, target.mask)
            pose = self.register(target.obj_id, points) if len(points) >= 10 else None
            if pose is None:
                self.refused.append(f"scene {frame.scene_id}, image {frame.im_id}, object {target.obj_id}: no pose")
                continue
            body = self.bodies[target.obj_id]
            camera_from_body, fitness = pose
            scale = 1.0 if body.model_from_mesh is None else body.metres
            score = target.score * fitness
            found.append(Estimate(target.obj_id, score, camera_from_body[:3, :3], camera_from_body[:3, 3], scale))
        return found

    def register(self, obj_id: int, points: np.ndarray) -> tuple[np.ndarray, float] | None:
        """The 4 × 4 pose of the object's mesh in metres among points [n, 3] of the camera, and the share of them that
        it explains; None where there is nothing to go by."""
        o3d, options = self.open3d, self.options
        registration = o3d.pipelines.registration
        body, feature, voxel = self._model(obj_id)
        scene = self._cloud(points).voxel_down_sample(voxel)
        if len(scene.points) < 10:
            return None
        scene.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(options.normal_radius * voxel, 30))
        scene.orient_normals_towards_camera_location(np.zeros(3))
        o3d.utility.random.seed(self.seed)
        coarse = registration.registration_ransac_based_on_feature_matching(
            scene,  # the part goes into the whole: every point of it has a partner
            body,
            self._feature(scene, voxel),
            feature,
            True,
            options.inlier * voxel,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(options.inlier * voxel),
            ],
            registration.RANSACConvergenceCriteria(options.iterations, options.confidence),
        )
        fine = coarse
        for reach in options.icp_reach:
            fine = registration.registration_icp(
                scene,
                body,
                reach * voxel,
                fine.transformation,
                registration.TransformationEstimationPointToPlane(),
                registration.ICPConvergenceCriteria(max_iteration=options.icp_steps),
            )
        camera_from_body = np.linalg.inv(fine.transformation)
        if not np.isfinite(camera_from_body).all() or fine.fitness == 0:
            return None
        # Sums in another order end differently in their last digits.
        return np.round(camera_from_body, 10), round(float(fine.fitness), 10)

    def _model(self, obj_id: int) -> tuple[Any, Any, float]:
        if obj_id not in self._models:
            o3d, body = self.open3d, self.bodies[obj_id]
            vertices = body.mesh.vertices * body.metres
            shape = o3d.geometry.TriangleMesh(
                o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(body.mesh.faces.astype(np.int32))
            )
            shape.compute_triangle_normals()
            voxel = self.options.voxel * diameter(vertices)
            o3d.utility.random.seed(self.seed)
            cloud = shape.sample_points_uniformly(self.options.samples, use_triangle_normal=True)
            cloud = cloud.voxel_down_sample(voxel)
            self._models[obj_id] = cloud, self._feature(cloud, voxel), voxel
        return self._models[obj_id]

    def _feature(self, cloud: Any, voxel: float) -> Any:
        near = self.open3d.geometry.KDTreeSearchParamHybrid(self.options.feature_radius * voxel, 100)
        return self.open3d.pipelines.registration.compute_fpfh_feature(cloud, near)

    def _cloud(self, points: np.ndarray) -> Any:
        return self.open3d.geometry.PointCloud(self.open3d.utility.Vector3dVector(points))


def unproject(frame: Frame, mask: np.ndarray | None) -> np.ndarray:
    """Points [n, 3], metres, of the masked pixels with a depth, without those far from the rest (a mask's border)."""
    if frame.depth is None:
        return np.zeros((0, 3))
    depth = frame.depth if mask is None else np.where(mask, frame.depth, 0)
    y, x = np.nonzero(depth > 0)
    z = depth[y, x].astype(np.float64)
    if len(z):
        middle = np.median(z)
        keep = np.abs(z - middle) < 5 * np.median(np.abs(z - middle)) + 0.02
        x, y, z = x[keep], y[keep], z[keep]
    return cameras.unproject(frame.camera, np.stack([x, y], axis=-1).astype(np.float64), z)


def diameter(vertices: np.ndarray) -> float:
    """The largest distance between two vertices, from those of the convex hull."""
    from scipy.spatial import ConvexHull
    from scipy.spatial.distance import pdist

    hull = vertices[ConvexHull(vertices).vertices]
    return float(pdist(hull[:: max(1, len(hull) // 2000)]).max())


def main() -> None:
    """Run it on a data set and score it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.classical", description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, metavar="DATA", help="in BOP layout")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--models", type=Path, help="another data set, to take the models from")
    parser.add_argument("--mesh-quality", type=int, default=0, choices=range(5))
    parser.add_argument("--mesh", action="append", metavar="N=FILE")
    parser.add_argument("--alignment", action="append", metavar="N=JSON")
    parser.add_argument("--only", type=int, nargs="+", help="only these objects")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--against", type=Path, metavar="CSV")
    options = parser.parse_args()
    import_open3d()  # before anything takes time
    dataset = Dataset(options.data, models=options.models)
    bodies = read_bodies(
        dataset,
        objects=options.only,
        quality=options.mesh_quality,
        seed=options.seed,
        meshes=parse_numbered(options.mesh, "--mesh"),
        alignments=parse_numbered(options.alignment, "--alignment"),
    )
    estimator = Classical(bodies, seed=options.seed)
    found = evaluate(
        dataset,
        list(bodies),
        estimator,
        options.output,
        method="classical",
        settings=estimator.settings(),
        alignments=estimator.alignments,
        aligned_by=estimator.aligned_by,
        metrics=("mssd", "mspd", "vsd", "add", "add_s"),
        against=options.against,
    )
    print(format_score(found))
    for line in estimator.refused:
        print(f"not found: {line}")


if __name__ == "__main__":
    main()
