"""The progress of a step, a bar for each of its parts."""


class Bars:
    """A progress bar for each part of the work."""

    def __init__(self, *, quiet: bool):
        self.quiet, self.part, self.bar = quiet, "", None

    def __enter__(self) -> "Bars":
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def show(self, part: str, done: int, total: int) -> None:
        """``done`` of ``total`` of this part are done."""
        from ipjax.progress import bar

        if part != self.part:
            self.__exit__()
            self.part, self.bar = part, bar(total=total, desc=part, disable=self.quiet, leave=False)
        if self.bar is not None:
            self.bar.update(done - self.bar.n)
