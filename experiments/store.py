"""Each run in its own folder, written whole or not at all.

    runs/<scenario>-<model>-<engine>-<identity>/
        manifest.json  scores.json  diagnostics.json  posterior.npz  posterior.json
        arms.csv       where the estimate is a junction
        lanes.csv  lanes.npz  lanes.osm   where it has lanes
        tracks.csv     where objects are tracked
        courses.json   diagnostics of the numbers of their courses
        figures/*.png, *.gif  report.html

The identity is a hash of the resolved config, of the source code and of the input files: a run that
is done under the same identity need not run again.
"""

from __future__ import annotations

import csv
import hashlib
import importlib.metadata
import json
import math
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from experiments.signatures import ConfigError, source_of

ROOT = Path(__file__).resolve().parents[1]
OWN = ("models", "inference", "experiments")
VERSIONS = ("waybayes", "torch", "pyro-ppl", "numpy", "scipy", "numba", "hydra-core", "matplotlib")


def identity(config: dict[str, Any]) -> str:
    """8 hex digits of what decides the outcome of a run."""
    digest = hashlib.sha256(json.dumps(config, sort_keys=True, default=str).encode())
    for file in _sources(config):
        digest.update(file.name.encode() + file.read_bytes())
    for path in _strings(config.get("scenario")):
        if Path(path).expanduser().is_file():
            digest.update(Path(path).expanduser().read_bytes())
    return digest.hexdigest()[:8]


def _sources(config: dict[str, Any]) -> list[Path]:
    """Source files of ours and of the packages that the config's targets come from."""
    tops = sorted({*OWN, *(target.partition(".")[0] for target in _strings(config, "_target_"))})
    files: list[Path] = []
    for top in tops:
        home = source_of(top) or ROOT / top / "__init__.py"
        files += sorted(home.parent.rglob("*.py")) if home.name == "__init__.py" else [home]
    return files


def _strings(node: Any, key: str | None = None) -> Iterator[str]:
    """Every string in a nested config, or those under one key."""
    pairs = node.items() if isinstance(node, dict) else enumerate(node if isinstance(node, list) else ())
    for name, value in pairs:
        if isinstance(value, str) and key in (None, name):
            yield value
        else:
            yield from _strings(value, key)


def check_folder(runs: Path) -> None:
    """Raise ConfigError where no runs can be stored below a folder, there or not; nothing is left behind."""
    place = next(place for place in (runs, *runs.absolute().parents) if place.exists())
    try:
        tempfile.TemporaryDirectory(dir=place).cleanup()
    except OSError as error:
        raise ConfigError(
            f"runs is '{runs}', but nothing can be written in '{place}' ({error.strerror}); choose another folder"
        ) from None


@contextmanager
def writing(folder: Path) -> Iterator[Path]:
    """A temporary sibling to write into; it takes the folder's name once all is written.

    Where the work fails, nothing stays behind and an older folder of the name stays as it was."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    temporary.chmod(0o755)
    try:
        yield temporary
        if folder.exists():
            folder.rename(temporary / ".old")
        temporary.rename(folder)
        shutil.rmtree(folder / ".old", ignore_errors=True)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def is_done(folder: Path) -> bool:
    """Whether a folder holds a completed run, nothing failed in it; one whose manifest is damaged does not."""
    file = folder / "manifest.json"
    try:
        told = read_json(file) if file.is_file() else None
    except ValueError:
        return False
    return isinstance(told, dict) and not told.get("failures")


def manifest(
    name: str, config: dict[str, Any], seeds: dict[str, int], seconds: dict[str, float], info: Any
) -> dict[str, Any]:
    """What it takes to understand and repeat a run.

    name     of the run's folder, which ends in its identity when it started
    seeds    of the run and of the engine
    seconds  per stage
    info     of the scene
    """
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "run": name,
        "config": config,
        "seeds": seeds,
        "seconds": seconds,
        "scene": info,
        "versions": {"python": platform.python_version()} | _versions(),
        "git": git_state(),
        "hardware": {
            "machine": platform.machine(),
            "system": platform.platform(terse=True),
            "processor": _processor(),
            "cores": os.cpu_count(),
        },
    }


def _versions() -> dict[str, str]:
    found = {}
    for name in VERSIONS:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def git_state() -> dict[str, Any]:
    """Commit of the source tree and whether it was changed since; None outside a checkout."""
    if not (ROOT / ".git").exists():
        return {"commit": None, "changed": None}
    ask = lambda *words: subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True).stdout  # noqa: E731
    try:
        return {"commit": ask("rev-parse", "HEAD").strip() or None, "changed": bool(ask("status", "--porcelain"))}
    except OSError:  # no git on this machine
        return {"commit": None, "changed": None}


def write_json(file: Path, content: Any) -> None:
    """Readable JSON; arrays become lists, NaN and infinities become null."""
    file.write_text(json.dumps(_jsonable(content), indent=2, allow_nan=False) + "\n")


def read_json(file: Path) -> Any:
    """What write_json wrote."""
    return json.loads(file.read_text())


def write_rows(file: Path, rows: list[dict[str, Any]]) -> None:
    """A CSV table of dictionaries; its columns are all their keys."""
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(dict.fromkeys(name for row in rows for name in row)))
        writer.writeheader()
        writer.writerows(rows)


def read_rows(file: Path) -> list[dict[str, str]]:
    """What write_rows wrote, as text."""
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def _jsonable(value: Any) -> Any:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(k): _jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
