"""What the answers of an estimator depend on."""

import re
from pathlib import Path

from ipjax.bop.estimator import hash_code


def test_results_hang_on_the_code(monkeypatch):
    """Every file whose change can change an estimate is in the hash; none of those that only print or score."""
    code = hash_code()
    assert re.fullmatch("[0-9a-f]{16}", code) and code == hash_code()
    read: list[str] = []
    opened = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda self: (read.append(self.name), opened(self))[1])
    hash_code()
    stages = {f"{n}.py" for n in ("pipeline", "matching", "alignment", "refinement", "scoring", "config", "frames")}
    assert stages | {"neighbours.py", "consensus.py", "rasterize.py"} <= set(read)
    assert not {"cli.py", "scores.py", "recalls.py"} & set(read)
