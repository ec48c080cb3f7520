"""All steps from a capture to a data set, in their order."""

from ipjax.capture.steps import depth, inspection, labels, models, poses, refinement
from ipjax.capture.steps.records import Step

STEPS: tuple[Step, ...] = (inspection.STEP, poses.STEP, refinement.STEP, depth.STEP, models.STEP, labels.STEP)
