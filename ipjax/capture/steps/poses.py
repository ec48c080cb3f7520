"""The step pose: where did the camera stand?"""

from ipjax.capture.poses.boards import parse_board
from ipjax.capture.poses.initial import find_poses
from ipjax.capture.poses.storing import write_poses
from ipjax.capture.steps.records import Figure, Job, Outcome, Step, say
from ipjax.files.wording import abbreviate

_FEWEST = 3  # frames with a pose
_AGREEING = 0.7  # share of the depth that agrees on the scale, below which poses are to be looked at


def pose(job: Job) -> Outcome:
    """The first poses, and what moves with the camera."""
    capture, settings = job.capture, job.settings
    found = find_poses(
        capture,
        settings.method,
        board=None if settings.board is None else parse_board(settings.board),
        find_gripper=settings.find_gripper,
        seed=settings.seed,
        progress=job.progress,
    )
    trajectory, moving = found.trajectory, found.still
    lines = write_poses(job.work, capture, found)
    outputs = ["poses.json", "tracks.npz", "trajectory.png", *(["ignore.png"] if moving.any() else [])]
    count = int(trajectory.registered.sum())
    figures = [
        Figure("frames with a pose", f"{count} of {len(trajectory)}", "", "the others are left out from here on")
    ]
    if trajectory.agreement is not None:
        meaning = "of the measured depths agree with the poses: 90 % and more are usual, below half they are refused"
        figures.append(Figure("agreement", round(100 * trajectory.agreement), "%", meaning))
    if found.tracks.count:
        figures.append(Figure("recognised points", found.tracks.count, "", "seen in several frames"))
        figures.append(
            Figure(
                "off", round(found.off, 2), "pixels", "by the median, the points from where frames see them; 1 is good"
            )
        )
    if moving.any():
        share = round(100 * float(moving.mean()))
        figures.append(Figure("moves along", share, "% of the image", "a hand, a gripper, a stand; it is left out"))
    warnings = []
    lost = [name for name, known in zip(trajectory.names, trajectory.registered, strict=True) if not known]
    if lost:
        warnings.append(
            f"{len(lost)} of {len(trajectory)} frames have no pose and are left out: {abbreviate(lost, 12)}."
        )
    if trajectory.agreement is not None and trajectory.agreement < _AGREEING:
        warnings.append(
            f"Only {100 * trajectory.agreement:.0f} % of the measured depths agree with the poses: look at the picture."
        )
    stop = None
    if count < _FEWEST:
        stop = f"Only {count} of {len(trajectory)} frames have a pose; a data set needs {_FEWEST} or more."
    return Outcome(tuple(outputs), tuple(figures), tuple(map(say, lines)), tuple(warnings), stop)


STEP = Step(
    name="pose",
    title="Where did the camera stand?",
    does="Finds the camera's place in every frame, in metres: as given, by a board, or by what frames recognise in one "
    "another and its depth; and what moves with the camera.",
    picture="trajectory.png",
    caption="Right if the cameras (blue first, red last) go the way that the hand went, without jumps, and the points "
    "draw the table and what stands on it.",
    needs=(),
    results=("poses.json", "tracks.npz"),
    sometimes=("ignore.png",),
    extras=(),
    modules=("ipjax.capture.steps.poses",),
    choose=lambda of: {"method": of.method, "board": of.board, "seed": of.seed, "find_gripper": of.find_gripper},
    make=pose,
)
