"""What is installed: the versions that are allowed, and a wheel that meets nobody else's packages."""

import pathlib
import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile

import pytest
from packaging.requirements import Requirement

ROOT = pathlib.Path(__file__).parent.parent
STAGES = ("datagen", "train", "eval")
PACKAGES = ("dipn_jax", *STAGES)


def _pins() -> dict[str, str]:
    """Versions of `constraints.txt`."""
    return dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines())


def test_the_versions_that_figures_were_made_with_are_allowed_and_faulty_ones_are_not() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    allowed = {one.name: one.specifier for one in map(Requirement, project["dependencies"])}
    pins = _pins()
    for name, versions in allowed.items():
        assert versions.contains(pins[name]), name
    for name in ("mujoco", "mujoco-mjx"):
        assert not allowed[name].contains("4.0.0") and allowed[name].contains("4.0.1")


def test_pins_leave_room_for_viser_and_botocore() -> None:
    pins = _pins()
    for room in ("rich<15", "websockets<17", "python-dateutil<3"):
        one = Requirement(room)
        assert one.specifier.contains(pins[one.name]), room


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Build our wheel from the sources alone."""
    out = tmp_path_factory.mktemp("wheel")
    source = out / "source"  # nothing that an earlier build left behind
    source.mkdir()
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(source)],
        check=True,
        capture_output=True,
    )
    (made,) = out.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def installed(wheel: pathlib.Path, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Install our wheel in a fresh environment that borrows the dependencies; return the folder of its scripts."""
    home = tmp_path_factory.mktemp("environment")
    venv.create(home, with_pip=False)
    python = home / "bin" / "python"
    site = pathlib.Path(_run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    borrowed = [path for path in sys.path if path.endswith("site-packages")]
    (site / "borrowed.pth").write_text("".join(f"{path}\n" for path in borrowed))
    install = ["-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--ignore-installed"]
    subprocess.run([sys.executable, *install, str(wheel)], check=True)
    return python.parent


def _run(program: pathlib.Path, *arguments: str, path: pathlib.Path | None = None) -> str:
    """Run a program outside the checkout with `path` on PYTHONPATH; return its standard output."""
    environment = {"PATH": "", "HOME": str(program.parent), **({"PYTHONPATH": str(path)} if path else {})}
    command = [str(program), *arguments]
    return subprocess.run(
        command, check=True, cwd=program.parent, env=environment, stdout=subprocess.PIPE, text=True
    ).stdout


@pytest.mark.slow
def test_the_wheel_holds_one_package_with_its_data(wheel: pathlib.Path, installed: pathlib.Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    top = {name.split("/")[0] for name in names}
    assert top == {"dipn_jax", next(name for name in top if name.endswith(".dist-info"))}
    assert {"dipn_jax/data/hard_cases.json", "dipn_jax/py.typed", "dipn_jax/eval/clearing/command.py"} <= set(names)
    for folder in (ROOT / "dipn_jax", *(ROOT / stage for stage in STAGES)):
        inside = "dipn_jax" if folder.name == "dipn_jax" else f"dipn_jax/{folder.name}"
        modules = {f"{inside}/{path.relative_to(folder)}" for path in folder.rglob("*.py")}
        assert modules <= set(names), modules - set(names)
    assert {f"dipn_jax/physics/{path.name}" for path in (ROOT / "dipn_jax" / "physics").glob("*.h")} <= set(names)
    script = (
        "import dipn_jax, pathlib; from dipn_jax.world.cases import hard_cases_path, load_cases; "
        "assert len(load_cases(hard_cases_path())[0]) == 10; "
        "[dipn_jax.load_network(pathlib.Path('builtin'), network=name) for name in ('dipn', 'grasp')]; "
        "print(dipn_jax.__file__)"
    )
    place = pathlib.Path(_run(installed / "python", "-c", script).strip())
    assert place.is_relative_to(installed.parent), place


@pytest.mark.slow
def test_a_users_own_packages_and_our_commands_do_not_meet(installed: pathlib.Path, tmp_path: pathlib.Path) -> None:
    """With somebody's packages `train`, `eval` and `datagen` on PYTHONPATH, theirs and ours both work."""
    for stage in STAGES:
        (tmp_path / stage).mkdir()
        (tmp_path / stage / "__init__.py").write_text("WHOSE = 'theirs'\n")
        (tmp_path / stage / "cli.py").write_text("raise SystemExit('imported by mistake')\n")
    for stage in STAGES:
        assert f"usage: dipn-{stage}" in _run(installed / f"dipn-{stage}", "--help", path=tmp_path)
    script = (
        "import importlib, pkgutil, dipn_jax, train, eval, datagen; "
        "[importlib.import_module(found.name) for found in pkgutil.walk_packages(dipn_jax.__path__, 'dipn_jax.')]; "
        "from dipn_jax.train import loop; assert loop.fit; "
        "print(train.WHOSE, eval.WHOSE, datagen.WHOSE)"
    )
    assert _run(installed / "python", "-c", script, path=tmp_path).split()[-3:] == ["theirs"] * 3
