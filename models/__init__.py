"""What the world is like: generative programs and their mathematics."""

import hashlib
import os
import sys
import tempfile
from pathlib import Path

PACKAGES = ("models", "inference", "planning")  # those with machine code


def _compiled_code_folder() -> str:
    """One folder of compiled code for each state of the sources.

    numba looks only at the file of a function when it asks whether its machine code is still good, not at the files of
    the functions it calls: after an edit it would run old mathematics. For speed, only functions that Python calls
    are kept (cache=True): one that is loaded from the disk cannot be inlined into its machine-code callers."""
    root = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for path in sorted(p for package in PACKAGES for p in (root / package).rglob("*.py")):
        digest.update(path.read_bytes())
    home = root if os.access(root, os.W_OK) else Path(tempfile.gettempdir())
    return str(home / ".compiled" / digest.hexdigest()[:12])


os.environ.setdefault("NUMBA_CACHE_DIR", _compiled_code_folder())
if "numba" in sys.modules:  # it read its settings before these were made
    sys.modules["numba"].config.reload_config()
