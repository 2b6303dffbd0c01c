"""The page with sliders in a real browser: its predictions are Python's."""

from __future__ import annotations

import copy
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import plate
import pytest

from crashkit.api.explore import explore
from crashkit.errors import DataError, OutputError
from evaluation.errors import EvaluationError
from evaluation.explorer.page import BrowserModel, ExplorerMesh, explorer_page, packed, rounded, triangles
from surrogates.errors import SurrogateError
from surrogates.settings import settings
from surrogates.storage.browser import browsable
from surrogates.storage.folder import save
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate

BROWSER = next((b for b in ("chromium", "chromium-browser", "google-chrome") if shutil.which(b)), None)
FLAGS = (
    "--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--virtual-time-budget=60000", "--dump-dom",
)  # fmt: skip
MODELS = {
    "mh": ["level.epochs=2", "transfer.epochs=1"],
    "gcn": ["level.epochs=2", "level.start=plain", "transfer.upsampling=linear", "inputs.products=true"],
    "mean": [
        "level.epochs=2",
        "level.regression=network",
        "level.reduction=pod",
        "level.latent=4",
        "levels=[2, 1]",
        "seeds=2",
    ],
    "coarse": ["level.epochs=2", "level.regression=mean"],
    "pod-gpr": [],
    "pod-gpr-coarse": [],
}


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Surrogate]]:
    """Small models of a plate, as folders and loaded."""
    home, out = tmp_path_factory.mktemp("models"), {}
    for name, told in MODELS.items():
        campaign = plate.waving_campaign(10) if name.endswith("coarse") else plate.campaign(10)
        model = "pod-gpr" if name.startswith("pod-gpr") else "mh"
        surrogate = train_surrogate(campaign, settings(model, overrides=told))
        assert surrogate.takes_coarse() == name.endswith("coarse")
        save(surrogate, home / name)
        out[name] = (home / name, surrogate)
    return out


def in_browser(page: Path, script: str) -> object:
    """What the JavaScript expression `script` gives in the page once it is ready."""
    ask = (
        '<script>(async()=>{while(document.documentElement.dataset.ready!=="yes")await new Promise(r=>setTimeout(r,20));'
        f"return await (async()=>{{{script}}})();}})().catch(e=>({{error:e.message}})).then(v=>{{"
        'const d=document.createElement("pre");d.id="answer";d.textContent=JSON.stringify(v);document.body.append(d);});</script>'
    )
    asking = page.with_name("asking.html")
    asking.write_text(page.read_text(encoding="utf-8").replace("</body>", ask + "</body>"), encoding="utf-8")
    done = subprocess.run(
        [str(BROWSER), *FLAGS, asking.as_uri()], capture_output=True, text=True, timeout=240, check=False
    )
    found = re.search(r'id="answer">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found is not None, done.stdout[-2000:] + done.stderr[-2000:]
    return json.loads(found[1].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&"))


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome is installed")
def test_twenty_predictions_of_every_model_and_level_are_those_of_python(
    models: dict[str, tuple[Path, Surrogate]], tmp_path: Path
) -> None:
    page = explore([folder for folder, _ in models.values()], tmp_path / "crash.html")
    rng = np.random.default_rng(0)
    asked, truth = [], []
    for name, (_, surrogate) in models.items():
        ranges = surrogate.record.ranges
        for _ in range(20):
            values = ranges.low + (ranges.high - ranges.low) * rng.uniform(size=len(ranges.names))
            time = float(rng.uniform(*ranges.time))
            for level in sorted({0, *surrogate.level_names.values()}):
                asked.append([name, dict(zip(ranges.names, values.tolist(), strict=True)), time, level])
                finest = min(surrogate.level_names.values())
                ask = surrogate.predict_full if level == 0 else surrogate.predict
                truth.append(ask(values, np.array([time]), finest if level == 0 else level)[0].ravel())
    found = in_browser(
        page,
        f"const out=[];for(const [n,p,t,l] of {json.dumps(asked)})out.push(Array.from(await crashkit.predict(p,t,l,n)));return out;",
    )
    assert isinstance(found, list)
    largest = max(np.abs(u).max() for u in truth)
    for given, expected in zip(found, truth, strict=True):
        np.testing.assert_allclose(given, expected, atol=1e-4 * largest)


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome is installed")
def test_band_and_warnings_are_those_of_python(models: dict[str, tuple[Path, Surrogate]], tmp_path: Path) -> None:
    mean = copy.copy(models["mean"][1])
    mean.bands = {at: replace(band, spread="deviation", local=None) for at, band in mean.bands.items()}
    save(mean, tmp_path / "mean")
    folds = train_surrogate(plate.folding(), settings("pod-gpr", overrides=plate.PLAIN_PROCESS))
    save(folds, tmp_path / "folds")
    page = explore(
        [models["mh"][0], models["pod-gpr"][0], tmp_path / "folds", tmp_path / "mean"], tmp_path / "crash.html"
    )
    found = in_browser(
        page,
        """
        const out = [];
        for (const name of crashkit.models) for (const angle of [0.5, 8]) {
          const query = {impact_speed: 22, impact_angle: angle, yield_stress: 3e8};
          out.push([Math.max(...await crashkit.band(query, 0.02, 0, name)), await crashkit.warnings(query, name)]);
        }
        return out;
        """,
    )
    assert isinstance(found, list)
    asked = [
        (s, [22.0, angle, 3e8]) for s in (models["mh"][1], models["pod-gpr"][1], folds, mean) for angle in (0.5, 8.0)
    ]
    for (width, said), (surrogate, query) in zip(found, asked, strict=True):
        expected = surrogate.band(0.9, [0.02], full=True, parameters=query).max()
        assert width == pytest.approx(float(expected), rel=1e-3)
        assert [s.removesuffix(", or compute a run") for s in surrogate.hard(query)] == [
            s for s in said if "outside" not in s
        ]
    assert folds.bands[0, False].spread == "local"
    assert ["fold" in " ".join(said) for _, said in found] == [*(4 * [False]), True, *(3 * [False])]


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome is installed")
def test_sliders_levels_and_holding_work_and_what_is_outside_is_said(
    models: dict[str, tuple[Path, Surrogate]], tmp_path: Path
) -> None:
    page = explore([models["mh"][0], models["pod-gpr"][0]], tmp_path / "crash.html", title="Plate <1>")
    said = in_browser(
        page,
        """
        const get = (id) => document.getElementById(id);
        const until = async (f) => { for (let k = 0; k < 200 && !f(); k++) await new Promise((r) => setTimeout(r, 20)); };
        const slider = document.querySelector('#sliders input');
        const before = get('numbers').textContent;
        get('hold').click();
        slider.value = slider.max; slider.dispatchEvent(new Event('input')); await until(() => get('warnings').textContent);
        const outside = get('warnings').textContent, both = get('numbers').textContent;
        get('level').value = '2'; get('level').dispatchEvent(new Event('change'));
        get('time').value = '0'; get('time').dispatchEvent(new Event('input'));
        await until(() => get('now').textContent === '0.0 ms');
        const sliders = document.querySelectorAll('#sliders input').length;
        return {before, outside, both, sliders, title: document.title, now: get('now').textContent};
        """,
    )
    assert isinstance(said, dict)
    assert said["title"] == "Plate <1>"
    assert said["sliders"] == 3
    assert "outside the trained range" in said["outside"]
    assert "the held one" in said["both"]
    assert said["before"] != said["both"]
    assert said["now"] == "0.0 ms"


def test_an_unknown_parameter_or_level_is_an_error_in_the_page(
    models: dict[str, tuple[Path, Surrogate]], tmp_path: Path
) -> None:
    if BROWSER is None:
        pytest.skip("no Chromium or Chrome is installed")
    page = explore(models["mh"][0], tmp_path / "crash.html")
    said = in_browser(page, "return await crashkit.predict({impact_speed: 20}, 0.01, 0);")
    assert said == {"error": "parameter impact_angle: expected a number, found undefined"}


def test_a_page_is_never_replaced_unasked(models: dict[str, tuple[Path, Surrogate]], tmp_path: Path) -> None:
    page = explore(models["mh"][0], tmp_path / "crash.html")
    text = page.read_text()
    with pytest.raises(OutputError, match="is there already"):
        explore(models["pod-gpr"][0], page)
    assert page.read_text() == text
    explore(models["pod-gpr"][0], page, overwrite=True)
    assert page.read_text() != text
    with pytest.raises(OutputError, match=r"ends in \.html"):
        explore(models["mh"][0], tmp_path / "crash.png")


def test_nothing_is_fetched_from_anywhere(models: dict[str, tuple[Path, Surrogate]], tmp_path: Path) -> None:
    text = explore(models["mh"][0], tmp_path / "crash.html").read_text()
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//", text)
    assert "import(" not in text


@pytest.mark.parametrize("what", ["none", "moved", "other faces"])
def test_models_of_different_meshes_do_not_share_a_page(
    models: dict[str, tuple[Path, Surrogate]], tmp_path: Path, what: str
) -> None:
    other = copy.copy(models["pod-gpr"][1])
    assert other.points is not None
    assert other.faces is not None
    if what == "none":
        other.points = other.faces = None
    elif what == "moved":
        other.points = other.points + np.array([0.0, 0.0, 1e-3])
    else:
        other.faces = other.faces[::-1]
    save(other, tmp_path / "other")
    with pytest.raises(DataError, match="another mesh"):
        explore([models["mh"][0], tmp_path / "other"], tmp_path / "crash.html")
    assert not (tmp_path / "crash.html").exists()


def test_what_has_no_form_for_a_browser_is_refused() -> None:
    surrogate = train_surrogate(plate.campaign(10), settings("pod-rbf"))
    with pytest.raises(SurrogateError, match="have a form for a browser"):
        browsable(surrogate, "rbf", "m0_")


def test_models_with_other_parameters_do_not_share_a_page() -> None:
    mesh = ExplorerMesh(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32))
    two = [BrowserModel({"parameters": [{"name": n}]}, {}) for n in ("a", "b")]
    with pytest.raises(EvaluationError, match="different parameters"):
        explorer_page("x", two, mesh)


def unzigzag(whole: np.ndarray, rows: int) -> np.ndarray:
    odd = whole % 2 == 1
    return np.where(odd, -(whole.astype(np.int64) + 1) // 2, whole.astype(np.int64) // 2).reshape(-1, rows).T


def test_rounded_columns_are_off_by_at_most_half_a_step() -> None:
    values = np.random.default_rng(0).normal(size=(50, 6)) * [1e-6, 1.0, 1e6, 1e-6, 1.0, 1e6]
    steps = np.array([1e-9, 1e-2, 1e2])
    whole = rounded(values, steps)
    assert whole is not None
    back = unzigzag(whole, 50) * np.tile(steps, 2)
    assert (np.abs(back - values) <= 0.5000001 * np.tile(steps, 2)).all()
    assert np.abs(back - values).max() > 0
    told = packed(values, steps)
    assert (told["columns"], len(told["steps"])) == (6, 3)


def test_what_is_rounded_coarsely_takes_less() -> None:
    values = np.random.default_rng(0).normal(size=(500, 4))
    sizes = [len(packed(values, np.full(4, step))["data"]) for step in (1e-6, 1e-3, 1e-1)]
    assert sizes[0] > 1.5 * sizes[1] > 2 * sizes[2]


def test_what_has_too_many_bits_stays_as_it_is() -> None:
    told = packed(np.array([[1.0, 2.0]]), np.array([1e-12]))
    assert told["kind"] == "f8"
    assert "steps" not in told


def test_quadrilaterals_become_two_triangles() -> None:
    faces = np.array([[0, 1, 2, 3], [4, 5, 6, -1]], np.int32)
    assert triangles(faces).tolist() == [[0, 1, 2], [4, 5, 6], [0, 2, 3]]
