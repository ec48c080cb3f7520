"""The packages in their order, and the place of every module in it."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

# From the first to the last: a module imports only from rows above its own, or from its own package.
ORDER = [
    ["ipjax_kernels"],
    ["ipjax.transforms"],  # records are made of them
    ["ipjax.records", "ipjax.config"],
    ["ipjax.cameras"],
    ["ipjax.metrics", "ipjax.networks"],
    # The graph. Its stages do not import one another.
    ["ipjax.estimation", "ipjax.estimation.photo", "ipjax.estimation.validity", "ipjax.estimation.contour"],
    ["ipjax.estimation.residuals"],
    [f"ipjax.estimation.{s}" for s in ("features", "matching", "alignment", "refinement", "scoring", "confidence")],
    ["ipjax.estimation.scene", "ipjax.estimation.photo.resection"],
    ["ipjax.estimation.photo.drawing"],
    ["ipjax.estimation.photo.extent", "ipjax.estimation.photo.contrasts"],
    ["ipjax.estimation.photo.polishing"],
    ["ipjax.estimation.photo.through_photo", "ipjax.estimation.photo.choice"],
    ["ipjax.estimation.pipeline"],
    # What cannot be jitted.
    ["ipjax.progress"],
    ["ipjax.files"],
    ["ipjax.rendering"],
    ["ipjax.inference"],
    ["ipjax.detection"],
    ["ipjax.onboarding"],
    ["ipjax.synthetic"],
    ["ipjax.bop"],
    ["ipjax.capture"],
    ["ipjax.robot"],
    ["ipjax.labelling"],
    ["ipjax.commands"],
    ["ipjax.cli"],
    ["ipjax.__main__"],
    ["ipjax"],  # the public names
]
LAYERS = {name: row for row, names in enumerate(ORDER) for name in names}
FIRST_IMPURE, FIRST_COMMAND = LAYERS["ipjax.progress"], LAYERS["ipjax.commands"]


def find_modules() -> dict[str, Path]:
    """Every module of both packages, by its dotted name."""
    found = {}
    for package in (ROOT / "ipjax", ROOT / "kernels" / "ipjax_kernels"):
        for path in sorted(package.rglob("*.py")):
            parts = list(path.relative_to(package.parent).with_suffix("").parts)
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = find_modules()


def layer_of(name: str) -> int:
    """The row of a module, or of the nearest package above it that has one."""
    return LAYERS[package_of(name)]


def package_of(name: str) -> str:
    """The name in `ORDER` that a module belongs to."""
    given = name
    # A stage that ORDER does not name has no place; a module of any other package has its package's.
    while name not in LAYERS or (name in ("ipjax", "ipjax.estimation", "ipjax.estimation.photo") and name != given):
        name, _, _ = name.rpartition(".")
        assert name, f"{given} has no place in ORDER"
    return name
