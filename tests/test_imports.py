"""Dependencies point one way, and the command line answers without the heavy ones."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ALLOWED = {
    "models": {"models"},
    "inference": {
        "inference",
        "models.program",
        "models.whitening",
        "models.capability",
        "models.overwrite",
        "models.formula",
        "models.multi_object",
    },
    "planning": {"planning", "models.clothoid", "models.frame", "models.formula", "models.program"},
    "experiments": {"experiments", "inference", "models", "planning"},
    "benchmarks": {"benchmarks", "experiments", "inference", "models", "planning"},
}
OURS = {"models", "inference", "planning", "experiments", "configs", "benchmarks", "tests", "examples"}


def imports_of(file: Path) -> Iterator[str]:
    """Dotted names that a file imports, wherever in the file."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{file}: imports of ours are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("package", ALLOWED)
def test_dependencies_point_one_way(package: str) -> None:
    files = list((ROOT / package).rglob("*.py"))
    assert files
    for file in files:
        for name in imports_of(file):
            if name.partition(".")[0] in OURS:
                allowed = any(f"{name}.".startswith(f"{head}.") for head in ALLOWED[package])
                assert allowed, f"{file.relative_to(ROOT)} imports {name}"


HEAVY = ("torch", "pyro", "numba", "arviz", "matplotlib", "scipy")


@pytest.mark.parametrize("words", [["--cfg", "job"], ["--help"]])
@pytest.mark.parametrize(("module", "knob"), [("run", "num_steps"), ("drive", "headway")])
def test_help_and_dry_run_import_nothing_heavy(module: str, knob: str, words: list[str], tmp_path: Path) -> None:
    code = (
        f"import sys\nfrom experiments.{module} import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        f"print('HEAVY', [name for name in {HEAVY} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=tmp_path, capture_output=True, text=True)
    assert knob in done.stdout, done.stderr
    assert done.stdout.rstrip().endswith("HEAVY []")
    assert not list(tmp_path.iterdir()), "a dry run writes nothing"


def test_compiled_code_lies_in_the_folder_of_these_sources_whichever_is_imported_first() -> None:
    """numba looks for the folder once: without it an edit of a function leaves its callers' old machine code in use."""
    for first in ("import numba, models", "import models, numba", "import experiments.road_metrics, numba"):
        code = f"import os\n{first}\nprint(numba.config.CACHE_DIR == os.environ['NUMBA_CACHE_DIR'] != '')"
        unset = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=unset, capture_output=True, text=True)
        assert done.stdout.strip() == "True", done.stderr
