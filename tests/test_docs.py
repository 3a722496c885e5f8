"""The pages that people read: links lead somewhere, commands exist, Python runs, figures are those of the JSON."""

import contextlib
import functools
import importlib
import importlib.util
import io
import pathlib
import re
import shutil
from collections.abc import Callable

import jax
import numpy as np
import page_commands
import pytest
import tyro
from dipn_jax.datagen.exporting.export import NEEDS
from dipn_jax.eval.report import paper
from dipn_jax.train import cli

from benchmarks import on_gpu
from benchmarks.__main__ import BENCHMARKS
from dipn_jax.commands import console
from dipn_jax.planning import methods
from dipn_jax.planning.policy_config import PolicyConfig
from dipn_jax.sight import render
from dipn_jax.system import files
from experiments import moving_picture, push_prediction, runs, tutorial_pictures

ROOT = pathlib.Path(__file__).parent.parent
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
SLOW = ("other_tools.md", "your_method.md")
"""Pages whose Python takes long."""
HOWTO = sorted((ROOT / "docs" / "howto").glob("*.md"))
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`(dipn-(?:datagen|train|eval) [^`]+)`")
OPTION = re.compile(r"`(--[a-z][a-z0-9_-]*)[^`]*`")
"""An option that stands in a sentence without its command."""
FOREIGN = {
    "--array",
    "--constraint",
    "--cpus-per-task",
    "--dependency",
    "--export",
    "--gpus-per-task",
    "--requeue",
    "--xla_gpu_enable_command_buffer",
}
"""Options of other programs, of which pages speak."""
OURS = {"--dry-run", "--minutes", "--list", "--only", "--page", "--scale", "--toy", "--out", "--seed"}
"""Options of experiments and benchmarks."""
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def parsed(words: list[str]) -> bool:
    """Check that a command's own parser accepts its words, without running the command."""
    program, *arguments = words
    called: list[str] = []

    def stub(name: str, command: Callable[..., None]) -> Callable[..., None]:
        return functools.wraps(command)(lambda **_: called.append(name))

    known = importlib.import_module(runs.PROGRAMS[program]).COMMANDS
    with contextlib.suppress(SystemExit):
        console.run(program, {name: stub(name, command) for name, command in known.items()}, arguments)
    training = arguments[arguments.index("--") + 1 :] if "--" in arguments else []  # of dipn-train sweep
    return called == arguments[:1] and (not training or parsed([program, *training, "--out", "one"]))


@each_page
def test_lines_are_short_and_links_lead_somewhere(page: pathlib.Path) -> None:
    text = page.read_text()
    for number, line in enumerate(text.splitlines(), 1):
        assert len(line) <= 120 or line.startswith("|"), f"{page}:{number}"
    for link in re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", text)):
        target, _, anchor = link.partition("#")
        assert not target.startswith("http"), f"{page}: {link}"
        there = (page.parent / target).resolve() if target else page
        assert there.exists(), f"{page}: {link}"
        if anchor:
            heads = re.findall(r"^#+ (.*)$", there.read_text(), re.MULTILINE)
            assert anchor in [head.lower().replace(" ", "-") for head in heads], f"{page}: {link}"


@each_page
def test_files_of_this_project_that_a_page_names_exist(page: pathlib.Path) -> None:
    for name in re.findall(r"`((?:\w+/)+[\w.]+\.(?:py|json|md))`", page.read_text()):
        assert any((base / name).exists() for base in (ROOT, ROOT / "dipn_jax")) or name.startswith(
            ("demo/", "mujoco/")
        ), name


@each_page
def test_commands_on_pages_exist(page: pathlib.Path, capfd: pytest.CaptureFixture[str]) -> None:
    makefile = (ROOT / "Makefile").read_text()
    for words in page_commands.commands(page):
        match words:
            case ["make", *targets]:
                named = [target for target in targets if "=" not in target]  # the others are variables
                assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in named), words
            case ["python", "-m", "benchmarks", *names]:
                assert all(name in BENCHMARKS for name in names), words
            case ["python", "-m", "benchmarks.on_gpu", *options]:
                on_gpu.parser().parse_args(options)
            case ["pip", command, *_]:
                assert command in ("download", "install"), words
            case ["python", "-m", "pytest", *options]:
                assert all((ROOT / option).exists() for option in options if option.endswith(".py")), words
            case ["python", "-m", "experiments.moving_picture", *options]:
                tyro.cli(functools.wraps(moving_picture.main)(lambda **_: None), args=options)
            case ["python", "-m", module, *options] if module.startswith("experiments."):
                assert importlib.import_module(module).main(["--dry-run", *options]) == 0, words
            case ["srun", *rest]:
                assert parsed(rest[next(i for i, word in enumerate(rest) if word in runs.PROGRAMS) :]), words
            case [program, *_]:
                assert program in runs.PROGRAMS and parsed(words), words
    assert not capfd.readouterr().err


@functools.cache
def help_of(program: str, command: str) -> str:
    """Return what `--help` of a command of ours prints."""
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
        console.run(program, importlib.import_module(runs.PROGRAMS[program]).COMMANDS, [command, "--help"])
    return shown.getvalue()


@each_page
def test_commands_and_options_within_sentences_exist(page: pathlib.Path) -> None:
    for words in (found.split() for found in INLINE.findall(FENCE.sub("", page.read_text()))):
        program, command, *rest = words
        known = importlib.import_module(runs.PROGRAMS[program]).COMMANDS
        for name in command.split("|"):  # one of several
            assert name in known or name.startswith("-"), words
        for option in (word for word in rest if word.startswith("--") and command in known):
            assert re.search(rf"{option}\b", help_of(program, command)), f"{option} of {' '.join(words)}"


@each_page
def test_options_within_sentences_are_options_of_some_command(page: pathlib.Path) -> None:
    commands = [(name, cmd) for name in runs.PROGRAMS for cmd in importlib.import_module(runs.PROGRAMS[name]).COMMANDS]
    for option in OPTION.findall(FENCE.sub("", page.read_text())):
        known = option in FOREIGN | OURS or any(re.search(rf"{option}\b", help_of(*command)) for command in commands)
        assert known, f"{option}: no command has it"


def test_the_readme_fits_on_a_screen_and_its_table_is_the_kept_one() -> None:
    text = (ROOT / "README.md").read_text()
    assert text.count("\n") <= 110 and (ROOT / "docs" / "clearing.gif").stat().st_size <= 1.5e6
    values = files.read_json(ROOT / "docs" / "clearing.json")
    titles = {"dipn+gn": "DIPN + GN", "dipn+gn+actions": "DIPN + GN, counting actions", "gn": "GN alone"}
    for on in ("heldout", "hard"):
        for method, title in titles.items():
            at = f"table/{on}/shipped/all/{method}"
            keys = ("completion", "grasps_that_held", "grasp_success_all", "efficiency_all")
            cells = [f"{100 * values[f'{at}/{key}']:.1f}" for key in keys]
            ends = [f"{100 * values[f'{at}/efficiency_all_{end}']:.0f}" for end in ("low", "high")]
            assert f"| {' | '.join([on, title, *cells])} [{', '.join(ends)}] |" in text
    published = dict(zip(paper.COLUMNS, paper.TABLE["hard"]["dipn+gn"], strict=True))
    said = "{completion:.1f}, {grasp_success_all:.1f} and {efficiency_all:.1f}".format(**published)
    assert f"for DIPN + GN on the hard tables {said}" in " ".join(text.split())


def test_the_steps_that_a_page_recommends_are_those_of_the_learning_curves() -> None:
    text = (ROOT / "docs" / "howto" / "your_network.md").read_text()
    rows = re.findall(r"^\| ([\d,]+) \| ([\d,]+) \| ([\d.]+) \|$", text, re.MULTILINE)
    table = {int(pushes.replace(",", "")): int(steps.replace(",", "")) for pushes, steps, _ in rows}
    assert table == push_prediction.STEPS
    for (pushes, steps), (*_, said) in zip(table.items(), rows, strict=True):
        passes = steps * cli.PUSH.batch / pushes
        assert said == (f"{passes:.0f}" if passes > 10 else f"{passes:.1f}")
    assert f"{cli.PUSH.steps:,} steps, is {cli.PUSH.steps * cli.PUSH.batch / 1350:.0f} passes over the 1,350 " in text


def test_the_rates_by_which_a_page_compares_engines_on_a_gpu_are_those_that_were_measured() -> None:
    text = " ".join((ROOT / "docs" / "howto" / "engines.md").read_text().split())
    rates = files.read_json(ROOT / "docs" / "benchmarks-h200.json")["figures"]
    native, mjx, warp = (
        round(max(rate for name, rate in rates.items() if name.startswith(f"engines.scene_seconds/{engine}/")))
        for engine in ("native", "mjx", "warp")
    )
    assert f"by {native} scene seconds a second under `native` on 16 cores, and by {mjx} under `mjx`" in text
    assert f"under `warp`, as it was at commit 4c8f9f8, by {warp}," in text
    assert "2.3 h, and the host's 16 cores 1.2 h" in (ROOT / "docs" / "scaling.md").read_text()


def test_the_changelog_is_short() -> None:
    versions = (ROOT / "CHANGELOG.md").read_text().split("\n## ")[1:]
    for version in versions:
        bullets = version.split("\n- ")[1:]
        assert len(bullets) <= 20
        assert all(bullet.split("\n\n")[0].count("\n") < 4 for bullet in bullets), version


def test_the_licence_and_the_citation_are_there() -> None:
    assert "Apache License" in (ROOT / "LICENSE").read_text()[:200]
    assert "license: Apache-2.0" in (ROOT / "CITATION.cff").read_text()


def prepare(folder: pathlib.Path, data: dict[str, pathlib.Path]) -> None:
    """Make what the pages' Python reads: a data set, runs (the shipped networks), a case file."""
    shutil.copytree(data["push"], folder / "data" / "push")
    for run, network in (("dipn", "dipn"), ("gn", "grasp")):
        shutil.copytree(ROOT / "dipn_jax" / "data" / network, folder / "runs" / run)
    cases = page_commands.block(ROOT / "docs" / "howto" / "your_cases.md", "json")
    (folder / "my_cases.json").write_text(cases)


def export_all(page: pathlib.Path) -> None:
    """Run the commands of a page that export a data set in formats whose libraries are there."""
    for program, *arguments in page_commands.commands(page):
        form = arguments[arguments.index("--format") + 1] if "--format" in arguments else "parquet"
        if all(importlib.util.find_spec(name) for name in NEEDS.get(form, ())):
            assert console.run(program, importlib.import_module(runs.PROGRAMS[program]).COMMANDS, arguments) == 0


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=[pytest.mark.slow] * (page.name in SLOW)) for page in (ROOT / "README.md", *HOWTO)],
    ids=lambda page: page.name,
)
def test_the_python_of_a_page_runs(
    page: pathlib.Path, data: dict[str, pathlib.Path], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare(tmp_path, data)
    monkeypatch.setattr(methods, "METHODS", dict(methods.METHODS))  # a page adds one
    with contextlib.chdir(tmp_path):
        if page.name == "other_tools.md":
            export_all(page)
        names = tutorial_pictures.run(page)
    if page.name == "README.md":
        decision, observation = names["decision"], names["observation"]
        _, row, col = decision.grasp_pixel
        assert not decision.is_push and decision.grasp_score > 0.9 and observation.label[row, col] >= 0
    elif page.name == "sweep_distance.md":
        travel = abs(names["motion"][0]).max((1, 2))
        assert travel[0] < travel[4] < travel[9], "longer pushes move further"
    elif page.name == "your_method.md":
        imagines = names["policy"].with_config(PolicyConfig(grasp_above=1.0))
        moved = np.abs(imagines(jax.random.key(0), names["observation"]).motion).max(-1) > 0
        assert "trans+gn" in methods.METHODS and moved.sum() == 1, "only the pushed object moves"
    elif page.name == "engines.md":
        assert not names["rollout"].fault.any()
    elif page.name == "your_cases.md":
        assert names["names"] == ["two-cubes"] and names["observation"].slots == 2
    elif page.name == "weights_elsewhere.md":
        assert names["kernel"].shape == (3, 3, 64, 24) and names["about"]["network"] == "grasp"
    elif page.name == "other_tools.md":
        assert names["pushes"].num_rows == 24 and names["some"]["height_before"].shape[1:] == (224, 224)
    elif page.name == "data_sets.md":
        assert names["episodes"].poses.shape[:2] == (24, 11)
        wanted = render.render(names["pushes"].scene[3], names["pushes"].poses[3, 0])
        np.testing.assert_array_equal(names["seen"][3].height, wanted.height)


@pytest.mark.slow
def test_the_tutorial_clears_its_table(tmp_path: pathlib.Path) -> None:
    with contextlib.chdir(tmp_path):
        names = tutorial_pictures.run(ROOT / "docs" / "tutorial.md")
    assert names["actions"][0] == "push" and names["actions"].count("grasp") == 4
    made = {path.name for path in (tmp_path / "tutorial").iterdir()}
    assert made == {path.name for path in (ROOT / "docs" / "tutorial").iterdir()}
