"""All steps from a capture to a data set, in their order."""

from ipjax.capture.steps import inspection, labels, models, poses, refinement
from ipjax.capture.steps.records import Step

STEPS: tuple[Step, ...] = (inspection.STEP, poses.STEP, refinement.STEP, models.STEP, labels.STEP)
