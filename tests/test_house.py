"""The house itself: layers, conventions, packaging."""

import ast
import importlib
import inspect
import pathlib
import pkgutil
import shutil
import subprocess
import sys
import zipfile

import pytest

ROOT = pathlib.Path(__file__).parent.parent
STAGES = ("datagen", "train", "eval")
# what stands on top of everything else, and is not in the wheel
TOPS = ("benchmarks", "experiments")
# library modules in the order of the arrows: each may import only what stands before it
ORDER = [
    "errors", "files", "machine", "structs", "workspace", "geometry", "batching", "engine",
    "world", "physics", "sight", "networks", "storage", "planning", "console",
]  # fmt: skip


def _imports(path: pathlib.Path) -> set[str]:
    """Full names of what a file imports: of `from a import b` both `a` and `a.b`; relative ones from `dipn_jax` on."""
    package = [*_package(path)]
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            names |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return names


def _package(path: pathlib.Path) -> tuple[str, ...]:
    """The package that a file is in, as it is imported."""
    parts = path.relative_to(ROOT).parent.parts
    return parts if parts[0] == "dipn_jax" else ("dipn_jax", *parts)


def _within(names: set[str], place: str) -> list[str]:
    return sorted(name for name in names if name == place or name.startswith(f"{place}."))


@pytest.mark.parametrize("stage", STAGES)
def test_stages_import_the_library_and_never_one_another(stage: str) -> None:
    for path in (ROOT / stage).rglob("*.py"):
        names = _imports(path)
        for other in set(STAGES) - {stage}:
            assert not _within(names, other) + _within(names, f"dipn_jax.{other}"), path
        assert not _within(names, stage), f"{path}: a stage imports its own modules as `from . import`"


def test_the_library_imports_no_stage() -> None:
    for path in (ROOT / "dipn_jax").rglob("*.py"):
        for stage in STAGES:
            assert not _within(_imports(path), stage) + _within(_imports(path), f"dipn_jax.{stage}"), path


@pytest.mark.parametrize("top", TOPS)
def test_nobody_imports_benchmarks_or_experiments_and_neither_imports_the_other(top: str) -> None:
    for package in {"dipn_jax", *STAGES, *TOPS} - {top}:
        for path in (ROOT / package).rglob("*.py"):
            assert not _within(_imports(path), top), path


def test_inside_the_library_the_arrows_point_one_way() -> None:
    for path in (ROOT / "dipn_jax").rglob("*.py"):
        room = path.relative_to(ROOT / "dipn_jax").parts[0].removesuffix(".py")
        if room in ("__init__", "data"):
            continue
        assert room in ORDER, f"{room}: give it a place in ORDER"
        for other in set(ORDER) - {room}:
            if found := _within(_imports(path), f"dipn_jax.{other}"):
                assert ORDER.index(other) < ORDER.index(room), f"{path} imports {found}"


def test_planner_knows_no_physics_and_networks_no_simulation() -> None:
    rules = (
        ("planning/planner.py", "physics"),
        ("planning/planner.py", "networks"),
        ("networks", "physics"),
        ("networks", "world"),
    )
    for room, forbidden in rules:
        place = ROOT / "dipn_jax" / room
        for path in [place] if place.is_file() else place.glob("*.py"):
            assert not any(name.startswith(f"dipn_jax.{forbidden}") for name in _imports(path)), path


def _public_functions() -> list[tuple[str, object]]:
    found = []
    for package in ("dipn_jax", *(f"dipn_jax.{stage}" for stage in STAGES)):
        for info in pkgutil.walk_packages([str(ROOT / package.split(".")[-1])], f"{package}."):
            module = importlib.import_module(info.name)
            for name, item in vars(module).items():
                item = inspect.unwrap(item) if callable(item) else item
                own = getattr(item, "__module__", None) == info.name
                if inspect.isfunction(item) and own and not name.startswith("_"):
                    found.append((f"{info.name}.{name}", item))
    return found


def test_conventions() -> None:
    functions = _public_functions()
    assert len(functions) > 80
    for name, function in functions:
        parameters = list(inspect.signature(function).parameters.values())
        assert function.__doc__, f"{name}: no docstring"
        assert all(p.annotation is not p.empty for p in parameters), f"{name}: untyped argument"
        keys = [i for i, p in enumerate(parameters) if p.name == "key"]
        assert keys in ([], [0]), f"{name}: the key comes first"
        for p in parameters:
            if p.default is not p.empty and not name.startswith(tuple(f"dipn_jax.{stage}." for stage in STAGES)):
                positional = p.kind is p.POSITIONAL_OR_KEYWORD
                allowed = {"fill", "config", "arguments", "note", "threads"}
                assert not positional or p.name in allowed, f"{name}: option {p.name} is keyword-only"


def test_every_module_has_a_docstring_and_is_of_readable_size() -> None:
    for package in ("dipn_jax", *STAGES, *TOPS):
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text()
            if text.strip():
                assert ast.get_docstring(ast.parse(text)), path
            assert text.count("\n") <= 320, path


@pytest.mark.slow
def test_the_wheel_holds_all_four_packages_and_the_data(tmp_path: pathlib.Path) -> None:
    """Built from the sources alone, installed into an empty folder, imported from there; dependencies are ours."""
    source = tmp_path / "source"  # nothing that an earlier build left behind
    source.mkdir()
    for package in ("dipn_jax", *STAGES):
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(source)],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "dipn_jax/data/hard_cases.json" in names and "dipn_jax/py.typed" in names
    assert not any(name.startswith(("tests", *TOPS)) for name in names)
    site = tmp_path / "site"
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(site), str(wheel)], check=True
    )
    script = (
        "import dipn_jax.world.cases, dipn_jax.datagen.cli, dipn_jax.train.cli, dipn_jax.eval.cli, pathlib; "
        "assert len(dipn_jax.world.cases.load_cases(dipn_jax.world.cases.hard_cases_path())[0]) == 10; "
        "import dipn_jax.storage.checkpoint as c; "
        "[c.load_network(pathlib.Path('builtin'), network=name) for name in ('dipn', 'grasp')]; "
        "assert pathlib.Path(dipn_jax.__file__).is_relative_to(pathlib.Path.cwd() / 'site'), dipn_jax.__file__"
    )
    environment = {"PYTHONPATH": str(site), "PATH": "", "HOME": str(tmp_path)}
    subprocess.run([sys.executable, "-c", script], check=True, cwd=tmp_path, env=environment)
