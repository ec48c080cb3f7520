"""How a mesh can be made from one photo: the methods by name, and what is said of each."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Method:
    """A way from a photo to a mesh.

    Attributes:
        description: what was done, as the report words it.
        network: the learned model, if there is one.
        licence: of its weights.
        keeps_camera: a camera that is given for the photo is used; a network may assume its own instead.
    """

    description: str
    network: str = ""
    licence: str = ""
    keeps_camera: bool = True

    def describe_weights(self) -> str:
        """The network and its licence in words."""
        return f"{self.network}, {self.licence}" if self.network else "no learned weights"


METHODS = {  # by the name that an object file keeps
    "depth": Method("its front measured by the depth image, its back guessed"),
    "elsewhere": Method("a mesh made elsewhere, with the photo that it was made from", keeps_camera=True),
    "inflate": Method("its outline inflated without learned weights"),
    "triposr": Method("reconstructed by TripoSR", "TripoSR", "MIT", keeps_camera=False),
}
CHOICES = ("triposr", "inflate", "auto")  # what may be asked for; with depth, "inflate" completes what was measured
