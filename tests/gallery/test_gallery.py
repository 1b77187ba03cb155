"""Every script of the gallery runs at a reduced size, and its figure is drawn."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "examples" / "gallery"
PAGES = (ROOT / "docs" / "gallery" / "gallery.md", ROOT / "docs" / "classic-method.md")


@pytest.fixture
def script(monkeypatch):
    """Import a script as it runs: its own folder first on the path."""
    monkeypatch.syspath_prepend(str(FOLDER))
    names = {path.stem for path in FOLDER.glob("*.py")}
    for name in names:
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield importlib.import_module
    import matplotlib.pyplot as plt

    plt.close("all")
    for name in names:
        sys.modules.pop(name, None)


def test_every_script_is_made_and_has_its_place(script):
    made = {module.__name__ for module in script("make_all").SCRIPTS}
    assert made == {path.stem for path in FOLDER.glob("*.py")} - {"common", "make_all"}
    text = "".join(page.read_text() for page in PAGES)
    for name in made:
        assert text.count(f"<!-- found: {name} -->") == 1


@pytest.mark.parametrize(
    "path", sorted((ROOT / "docs" / "gallery").glob("*.png")), ids=lambda p: p.name
)
def test_figures_are_small_and_shown(path):
    assert path.stat().st_size <= 120_000
    assert any(f"{path.name})" in page.read_text() for page in PAGES)


@pytest.mark.slow
def test_linear_model(script):
    module = script("linear_model")
    found = module.compute(nodes=(11, 21))
    assert found["linear"].solution.history[-1].ranks == (1,)
    assert all(model.order > 1.6 for model in found.values())
    assert len(module.draw(found).axes) == 6
    assert "observed order" in module.report(found)


@pytest.mark.slow
def test_free_fall(script):
    module = script("free_fall")
    found = module.compute(updates=(2, 12))
    assert found.plain <= 1e-4
    first, last = found.errors["defaults, 2 slabs"]
    assert last < 0.1 * first
    assert "after 2" in module.report(found)
    module.draw(found)


@pytest.mark.slow
def test_coupled(script):
    module = script("coupled")
    found = module.compute(updates=(1, 4), variants=("defaults, 8 modes",))
    assert found.plain <= 1e-3
    first, last = found.errors["defaults, 8 modes"]
    assert last < 0.1 * first
    assert "after 4" in module.report(found)
    module.draw(found)


@pytest.mark.slow
def test_coupled_scaling(script):
    module = script("coupled_scaling")
    found = module.compute(nodes=(5, 6, 7), repeats=1, variants=("PGD, defaults",))
    assert max(found.errors["PGD, defaults"]) < 1e-3
    assert found.grid_error < 1e-3
    assert "crossing" in module.report(found)
    module.draw(found)


@pytest.mark.slow
def test_lotka_volterra(script):
    module = script("lotka_volterra")
    runs = module.compute(rtol=1e-2, tight=1e-3)
    for run in runs.values():
        size = np.abs(run.exact).max()
        assert np.abs(run.curves[..., ::8] - run.exact).max() < 2e-2 * size
    assert "T = 6" in module.report(runs)
    module.draw(runs)


@pytest.mark.slow
def test_rigid_body(script):
    module = script("rigid_body")
    runs = module.compute(rtol=1e-2, tight=1e-3)
    for run in runs.values():
        assert np.abs(run.curves[..., ::8] - run.exact).max() < 2e-2
    assert "T = 0.25" in module.report(runs)
    module.draw(runs)


@pytest.mark.slow
def test_convergence_study(script):
    module = script("convergence_study")
    study = module.compute(("decay, T = 2",), modes=(1, 4), rtols=(1e-2, 1e-5))
    lines = study["decay, T = 2"]
    assert set(lines) == {*module.VARIANTS, "train"}
    for points in lines.values():
        assert points[1].error < points[0].error
    assert "| decay, T = 2 | all modes |" in module.report(study)
    assert set(module.draw(study)) == {"convergence_modes", "convergence_seconds"}


def test_numbers_and_figures_are_published(script, tmp_path, monkeypatch):
    common = script("common")
    monkeypatch.setattr(common, "FOLDER", tmp_path)
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- found: one -->\nold\n<!-- /found -->\nafter\n")
    common.publish("one", "new", {"one": common.figure(1, 1)[0]}, tmp_path, page)
    assert page.read_text() == "before\n<!-- found: one -->\nnew\n<!-- /found -->\nafter\n"
    assert (tmp_path / "one.png").stat().st_size > 0
    with pytest.raises(AssertionError, match="no place for two"):
        common.publish("two", "new", {}, tmp_path, page)


@pytest.fixture
def docs_are_left_alone():
    """The docs are the same afterwards; put back if they are not."""
    before = {path: path.read_bytes() for path in (*PAGES, *PAGES[0].parent.iterdir())}
    yield
    changed = [path for path, content in before.items() if path.read_bytes() != content]
    for path in changed:
        path.write_bytes(before[path])
    assert not changed
    assert set(PAGES[0].parent.iterdir()) <= set(before)


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.usefixtures("docs_are_left_alone")
def test_figures_go_elsewhere_unless_asked(script, tmp_path, monkeypatch, capsys, named):
    make_all, common = script("make_all"), script("common")
    names = set()
    for module in make_all.SCRIPTS:
        name = module.__name__
        names.add(f"{name}.png")
        monkeypatch.setattr(module, "compute", lambda: None)
        monkeypatch.setattr(module, "report", lambda found: "numbers")
        drawn = common.figure(1, 1)[0]
        made = {name: drawn} if name == "convergence_study" else drawn
        monkeypatch.setattr(module, "draw", lambda found, made=made: made)
    monkeypatch.setattr(common.tempfile, "tempdir", str(tmp_path))
    common.run_script(make_all.main, ["--to", str(tmp_path / "a" / "b")] if named else [])
    (folder,) = tmp_path.glob("a/b" if named else "gallery-*")
    assert {path.name for path in folder.iterdir()} == names
    assert f"figures are in {folder}\n" in capsys.readouterr().out


def test_docs_are_updated_when_asked(script):
    common, folders = script("common"), []
    common.run_script(folders.append, ["--update"])
    assert folders == [PAGES[0].parent]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", str(PAGES[0].parent)], "by --update only"),
        (["--to", str(PAGES[0])], "File exists"),
        (["--to", "somewhere", "--update"], "not allowed with"),
    ],
)
def test_folders_that_are_refused(script, capsys, arguments, message):
    with pytest.raises(SystemExit):
        script("common").run_script(pytest.fail, arguments)
    assert message in capsys.readouterr().err
