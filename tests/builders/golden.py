"""Where the golden files are: numbers that other implementations computed on our own inputs."""

from pathlib import Path

GOLDEN = Path(__file__).resolve().parents[1] / "golden"
