"""The structure of the project: layers and conventions."""

import ast
import functools
import importlib
import inspect
import pathlib
import pkgutil
import re

import pytest

import dipn_jax

ROOT = pathlib.Path(__file__).parent.parent
STAGES = ("datagen", "train", "eval")
PACKAGES = ("dipn_jax", *STAGES)
TOPS = ("benchmarks", "experiments")
"""Packages that may import everything, are imported by nothing, and are not in the wheel."""
MOST_LINES = 300
"""Largest number of lines in a file."""
# library modules in the order of the arrows: each may import only what stands before it
ORDER = [
    "errors", "names", "seeds", "system", "commands", "structs", "workspace", "geometry", "batching", "engine", "world",
    "physics", "sight", "networks", "storage", "planning",
]  # fmt: skip


@functools.cache
def _tree(path: pathlib.Path) -> ast.Module:
    return ast.parse(path.read_text())


@functools.cache
def _calls(path: pathlib.Path) -> list[tuple[str, ast.Call]]:
    """Return the calls in a file, each with what is called."""
    return [(ast.unparse(node.func), node) for node in ast.walk(_tree(path)) if isinstance(node, ast.Call)]


@functools.cache
def _imports(path: pathlib.Path) -> set[str]:
    """Return full names of what a file imports: of `from a import b` both `a` and `a.b`, relative ones resolved."""
    package = [*_package(path)]
    names: set[str] = set()
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            names |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return names


def _package(path: pathlib.Path) -> tuple[str, ...]:
    """Return the name of the package that a file is in, as it is imported."""
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
                # what a public function is about, such as the method of `load_policy`
                subject = p is parameters[0] and name.rpartition(".")[2] in dipn_jax.__all__
                assert not positional or subject or p.name in allowed, f"{name}: option {p.name} is keyword-only"


def test_every_module_has_a_docstring() -> None:
    for package in (*PACKAGES, *TOPS):
        for path in (ROOT / package).rglob("*.py"):
            assert ast.get_docstring(_tree(path)), path


def test_every_room_and_module_of_the_library_is_on_the_page_of_concepts() -> None:
    rooms = (ROOT / "docs" / "concepts.md").read_text().partition("## The rooms of the code")[2].partition("\n## ")[0]
    for name in ORDER:
        shown = f"`dipn_jax/{name}/`" if (ROOT / "dipn_jax" / name).is_dir() else f"{name}.py`"
        assert re.search(rf"[`/]{re.escape(shown.removeprefix('`'))}", rooms), name


def test_the_makefile_is_short_and_its_modules_exist() -> None:
    lines = (ROOT / "Makefile").read_text().splitlines()
    assert len(lines) <= 40 and max(map(len, lines)) <= 120
    modules = {word for line in lines for word in line.split() if word.startswith("experiments.")}
    for name in modules - {"experiments.NAME"}:
        assert (ROOT / name.replace(".", "/")).with_suffix(".py").is_file(), name


def test_text_files_are_read_and_written_as_utf8() -> None:
    """A call that opens a text file names its encoding, or the locale chooses one; `files` has functions for both."""
    for package in (*PACKAGES, "experiments"):
        for path in (ROOT / package).rglob("*.py"):
            for called, call in _calls(path):
                if re.search(r"(?<!files)(?<!os)\.(read_text|write_text|open)$", called):
                    modes = [str(arg.value) for arg in call.args if isinstance(arg, ast.Constant)]
                    named = any(keyword.arg == "encoding" for keyword in call.keywords)
                    assert named or any("b" in mode for mode in modes), f"{path}: {called}"


def test_bytes_are_read_in_one_place() -> None:
    """`files.read_bytes` refuses what is no regular file, such as a pipe, which could be read for ever."""
    allowed = {ROOT / "dipn_jax" / "system" / "files.py", ROOT / "dipn_jax" / "storage" / "owner.py"}
    for package in PACKAGES:
        for path in {*(ROOT / package).rglob("*.py")} - allowed:
            assert not [name for name, _ in _calls(path) if re.search(r"(?<!^files)\.read_bytes$", name)], path


def test_no_message_shows_a_list_of_python() -> None:
    """A user reads words, not brackets and quotes; but shapes of arrays are tuples."""
    collections = (ast.List, ast.Dict, ast.Set, ast.ListComp, ast.SetComp, ast.DictComp)
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            for called, call in _calls(path):
                if re.search(r"(^|\.)(UserError|say|warn|note)$", called):
                    shown = [part.value for part in ast.walk(call) if isinstance(part, ast.FormattedValue)]
                    made = [one for one in shown if isinstance(one, collections)]
                    made += [one for one in shown if re.match(r"(sorted|list|dict|set)\(", ast.unparse(one))]
                    assert not made, f"{path}: {ast.unparse(call)}"


def test_nothing_is_pickled() -> None:
    """Unpickling would run what is in a file; every call of NumPy that could do so has `allow_pickle=False`."""
    forbidden = {"pickle", "_pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
    for package in (*PACKAGES, *TOPS):
        for path in (ROOT / package).rglob("*.py"):
            assert not {name.split(".")[0] for name in _imports(path)} & forbidden, path
            for called, call in _calls(path):
                if re.fullmatch(r"(np|numpy|jnp)\.(load|save|savez|savez_compressed)", called):
                    said = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
                    assert said.get("allow_pickle") == "False", f"{path}: {ast.unparse(call)}"


def test_files_are_renamed_in_one_place() -> None:
    """`files.move` syncs what it renames, and the folder afterwards."""
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            called = {name for name, _ in _calls(path)}
            renaming = {name for name in called if name.endswith(".rename") or name in ("os.replace", "shutil.move")}
            assert not renaming or path == ROOT / "dipn_jax" / "system" / "files.py", f"{path}: {renaming}"


def test_figures_of_evaluations_are_written_whole() -> None:
    """`drawing` draws into memory and hands the bytes to `files.write_atomically`."""
    for path in (ROOT / "eval").rglob("*.py"):
        called = {name for name, _ in _calls(path) if name.endswith(".savefig")}
        assert not called or path == ROOT / "eval" / "drawing.py", f"{path}: {called}"


def test_no_file_is_longer_than_300_lines() -> None:
    lines = {
        path.relative_to(ROOT): path.read_text().count("\n")
        for folder in (*PACKAGES, "benchmarks", "tests", "examples", "experiments", "docs")
        for path in (ROOT / folder).rglob("*.py")
    }
    assert len(lines) > 100 and {path: count for path, count in lines.items() if count > MOST_LINES} == {}


def test_every_folder_of_tests_mirrors_a_package() -> None:
    """Each test is in the folder that mirrors its subject; no `__init__.py` there, which would shadow ours."""
    tests = ROOT / "tests"
    assert not list(tests.rglob("__init__.py"))
    folders = {path.parent.relative_to(tests) for path in tests.rglob("test_*.py")} - {pathlib.Path()}
    assert len(folders) > 10
    assert [folder for folder in sorted(folders) if not (ROOT / folder / "__init__.py").exists()] == []
    rooms = {path.parent.relative_to(ROOT) for path in (ROOT / "dipn_jax").rglob("__init__.py")}
    assert sorted(rooms - folders) == [pathlib.Path("dipn_jax/data")], "a room without tests"
