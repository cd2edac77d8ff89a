"""A folder is an extra or a trust boundary: which module may import which, read from the sources and seen in fresh interpreters."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from pathlib import Path
from types import FrameType

import numpy as np
import pytest
from import_graph import all_imports_of, imports_of, source_of

from runtime import Estimator
from runtime.image import runway_image

ROOT = Path(__file__).parents[1]
ROOTS = (ROOT, ROOT / "scripts")
EXTRAS = (
    *("torch", "onnx", "onnxscript", "typer", "rich", "flint", "joblib", "faery", "cv2", "h5py", "hdf5plugin", "lz4", "zstandard"),
    *("matplotlib", "dask", "distributed"),
)
"""Import names of what the embedded runtime must do without."""
SHARED_WITH_VERIFIER = {
    "build_model.filter_graph",  # the writer of the graph that the file's tables demand, with its parts
    "build_model.bank_graph",
    "build_model.mask_graph",
    "build_model.window_graph",
    "build_model.filter_tables",  # what the graph is made of
    "build_model.partition",  # what a list of cells is; the verifier makes its own
    "build_model.window",
    "runtime",
    "runtime.assumptions",  # words
    "runtime.attitude",  # imported by what makes a lens's tables, which are proved, with the next ones so marked (*)
    "runtime.domain",  # how a scene is divided into cells, which the verifier derives anew
    "runtime.errors",
    "runtime.ideal",  # which scene the ideal frame has
    "runtime.lens",  # *
    "runtime.model",
    "runtime.model.format",
    "runtime.model.limits",  # numbers
    "runtime.model.model_file",
    "runtime.model.onnx_subset",
    "runtime.model.operators",  # what a graph may hold
    "runtime.model.operators.elementwise",
    "runtime.model.operators.graph",
    "runtime.model.operators.layout",
    "runtime.model.operators.products",
    "runtime.model.operators.table",
    "runtime.model.operators.tensor",
    "runtime.model.protobuf",
    "runtime.outline",  # *
    "runtime.painting",  # *
    "runtime.refine",
    "runtime.refine.interval",  # *
    "runtime.refine.optics",  # *
    "runtime.rounding",  # *
    "runtime.scene",
    "runtime.scene_error",
    "runtime.sensor_map",  # *
    "runtime.state_set",  # *
    "runtime.terminal",  # what the command prints on
    "runtime.turn",  # the scene's reader takes the tangents of a glide's angles with it; the verifier takes them anew
}
"""All that the proof may load of the project beside its own: no mask, bound or rounding of the build, no state network, no refinement.

Behind a lens the runtime derives tables from the scene, which the proof takes from it and holds against the lens's own formulas.
"""


def modules_below(folder: Path, root: Path) -> list[str]:
    names = (path.relative_to(root).with_suffix("").parts for path in folder.rglob("*.py"))
    return sorted(".".join(parts[:-1] if parts[-1] == "__init__" else parts) for parts in names)


MODULES = [
    name
    for folder, root in ((ROOT / "runtime", ROOT), (ROOT / "build_model", ROOT), (ROOT / "scripts", ROOT / "scripts"))
    for name in modules_below(folder, root)
]
CORE = [name for name in MODULES if name.startswith("runtime") and not name.startswith("runtime.recordings")]
OF_VERIFIER = {"build_model", *(name for name in MODULES if name.startswith("build_model.verify"))}


def run_python(program: str) -> str:
    """What a fresh interpreter prints, started in the repository's root; a failure shows its stderr."""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded_with(module: str, before: str = "") -> set[str]:
    """The modules that a fresh interpreter has loaded after it has run `before` and imported the module."""
    return set(run_python(f"import sys\n{before}\nimport {module}\nprint(*sys.modules)").split())


def direct_imports(module: str) -> set[str]:
    path = source_of(module, ROOTS)
    assert path is not None
    return imports_of(path, ROOTS)


def test_all_modules_are_seen() -> None:
    assert {"runtime", "runtime.scene", "runtime.model.format", "build_model.export", "coverage.judge", "fly_approach"} <= set(MODULES)
    assert all(source_of(name, ROOTS) for name in MODULES)


# --- the embedded runtime ---


def test_importing_the_runtime_imports_no_extra_and_no_build_model() -> None:
    loaded = {name.partition(".")[0] for name in loaded_with("runtime")}
    assert {"runtime", "numpy", "onnxruntime"} <= loaded
    assert loaded & {"build_model", *EXTRAS} == set()


@pytest.mark.parametrize("module", CORE)
def test_every_module_of_the_core_can_be_imported_without_the_extras(module: str) -> None:
    """An entry of None in sys.modules makes an import fail as if the package were not installed."""
    blocked = ["build_model", "runtime.recordings", *EXTRAS]
    loaded = loaded_with(module, f"sys.modules.update(dict.fromkeys({blocked!r}))")
    assert {name for name in loaded if name.startswith("runtime.recordings.")} == set()


@pytest.mark.parametrize("module", CORE)
def test_no_module_of_the_core_imports_recordings(module: str) -> None:
    assert {name for name in direct_imports(module) if name.startswith("runtime.recordings")} == set()


def test_the_runtime_never_imports_build_model_or_scripts() -> None:
    runtime = [name for name in MODULES if name.startswith("runtime")]
    assert {name: direct_imports(name) - set(runtime) for name in runtime if direct_imports(name) - set(runtime)} == {}
    assert "runtime.scene" in direct_imports("build_model.partition")


@pytest.mark.parametrize("module", [name for name in MODULES if name.startswith("runtime.recordings")])
def test_the_extra_recordings_imports_at_the_top(module: str) -> None:
    """A reader with a package of its own is a module of its own, which `recording` imports when a file asks for it."""
    path = source_of(module, ROOTS)
    assert path is not None
    functions = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)]
    assert not any(isinstance(inner, ast.Import | ast.ImportFrom) for function in functions for inner in ast.walk(function))


# --- a frame's way ---


@pytest.mark.parametrize("extra_budget", [-1, 3])
def test_a_frames_way_through_estimate_climbs_no_floor_twice(extra_budget: int) -> None:
    """No module is called, over however many others, by one that it calls: read from the calls of a frame, Theorem B's too."""
    estimator = Estimator.load(extra_budget=extra_budget)
    frame = runway_image(estimator.scene, np.array([0.62, 0.0, 0.93, 1.71]))
    callers: dict[str, set[str]] = {}

    def note(called: FrameType, event: str, _: object) -> None:
        caller = called.f_back and called.f_back.f_globals.get("__name__", "")
        name = called.f_globals.get("__name__", "")
        if event == "call" and caller and caller != name and {caller, name} <= set(CORE):
            callers.setdefault(name, set()).add(caller)

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        estimate = estimator.estimate(frame)
    finally:
        sys.setprofile(before)
    assert estimate.certified
    floors = list(graphlib.TopologicalSorter(callers).static_order())
    assert floors[0] == "runtime.estimator"
    assert {"runtime.model.entries", "runtime.refine.refiner", "runtime.refine.sight", "runtime.refine.regions"} <= set(floors)
    assert ("runtime.refine.theorem_b" in floors) == (extra_budget >= 0)


# --- the demonstration ---


def test_the_demonstration_on_the_committed_model_needs_only_what_draws() -> None:
    drawing = {"typer", "rich", "cv2", "matplotlib"}
    blocked = ["build_model", *(name for name in EXTRAS if name not in drawing)]
    loaded = loaded_with("fly_approach", f"sys.modules.update(dict.fromkeys({blocked!r}))\nsys.path.insert(0, 'scripts')")
    assert drawing <= loaded


# --- the verifier ---


def test_the_proof_loads_exactly_what_is_listed() -> None:
    """`runtime` is taken for a bare package: what it offers its users is no part of the proof."""
    bare = "import types\nruntime = sys.modules['runtime'] = types.ModuleType('runtime')\nruntime.__path__ = ['runtime']"
    loaded = {name for name in loaded_with("build_model.verify.cli", bare) if name.partition(".")[0] in ("runtime", "build_model")}
    assert loaded == OF_VERIFIER | SHARED_WITH_VERIFIER


def test_the_command_that_proves_loads_no_torch() -> None:
    loaded = loaded_with("build_model.verify.cli")
    assert {
        "torch",
        "build_model.hough_bank",
        "build_model.enclosure",
        "build_model.spatial_filter",
        "build_model.pixel_mask",
    } & loaded == set()


def test_no_module_of_the_proof_imports_another_later() -> None:
    for module in OF_VERIFIER:
        assert direct_imports(module) <= OF_VERIFIER | SHARED_WITH_VERIFIER, module


# --- all ---


def test_imports_go_one_way() -> None:
    """No module is imported, over however many others, by one that it imports: also not inside a function."""
    graphlib.TopologicalSorter({name: direct_imports(name) for name in MODULES}).prepare()


def test_a_circle_would_be_seen(tmp_path: Path) -> None:
    (tmp_path / "pack").mkdir()
    sources = {
        "pack/__init__.py": "",
        "pack/one.py": "from pack import two",
        "pack/two.py": "def late():\n    import three",
        "three.py": "from pack.one import name",
        "other.py": "from pack.two import late\nimport numpy",
    }
    for name, text in sources.items():
        (tmp_path / name).write_text(text)
    modules = modules_below(tmp_path, tmp_path)
    graph = {name: imports_of(source_of(name, [tmp_path]) or tmp_path, [tmp_path]) for name in modules}
    assert graph == {"pack": set(), "pack.one": {"pack.two"}, "pack.two": {"three"}, "three": {"pack.one"}, "other": {"pack.two"}}
    with pytest.raises(graphlib.CycleError):
        graphlib.TopologicalSorter(graph).prepare()
    assert list(all_imports_of(["other"], [tmp_path])) == modules
    assert list(all_imports_of(["pack"], [tmp_path])) == ["pack"]
