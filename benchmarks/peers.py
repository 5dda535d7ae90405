"""The peers' virtual environment, which ``make`` installs from ``peers.lock``."""

from __future__ import annotations

import subprocess
from pathlib import Path

__all__ = ["NONE", "PYTHON", "peer_python"]

ROOT = Path(__file__).resolve().parent.parent
PYTHON = ROOT / ".venv-peers" / "bin" / "python"
NONE = "none"
LIBRARIES = ("stable_baselines3", "sbx")
MISSING = "import sys, importlib.util as u; print(*[n for n in sys.argv[1:] if not u.find_spec(n)])"


def peer_python(given: str | Path) -> Path | None:
    """The peers' Python given by ``--peer``; ``None`` if it is ``"none"``.

    Raises:
        SystemExit: with an error message, if the peers are not installed.
    """
    if str(given) == NONE:
        return None
    cure = f"`make .venv-peers/.complete` installs the peers, --peer {NONE} leaves them out"
    try:
        command = [given, "-c", MISSING, *LIBRARIES]
        answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        raise SystemExit(f"Error: {given} is not a Python that runs; {cure}.") from None
    if missing := answer.split():
        raise SystemExit(f"Error: {given} has no {' and no '.join(missing)}; {cure}.")
    return Path(given)
