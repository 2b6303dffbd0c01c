"""Settings: where they come from, who wins, and what is said when they are wrong."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

from surrogates.errors import SurrogateError
from surrogates.settings import Settings, parse, settings


def test_the_paper_preset_is_the_papers_network() -> None:
    level = settings("mh", "paper").level
    assert (level.latent, level.channels, level.order, level.mlp.widths) == (4, (6, 12, 24), 3, (64, 64, 64))
    assert (level.mlp.activation, level.start, level.schedule, level.batch) == ("elu", "plain", "constant", 32)


def test_podnn_has_four_modes_in_both_presets() -> None:
    for preset in ("fast", "paper"):
        chosen = settings("podnn", preset)
        assert (chosen.level.reduction, chosen.level.latent, chosen.levels) == ("pod", 4, (0,))


def test_overrides_win_over_the_file_and_the_file_over_the_preset(tmp_path: Path) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text("model: aenn\nlevel: {epochs: 7, batch: 5}\n")
    chosen = settings(file=file, overrides=["level.epochs=9"])
    assert (chosen.model, chosen.level.epochs, chosen.level.batch) == ("aenn", 9, 5)
    assert chosen.level.schedule == settings("aenn").level.schedule


@pytest.mark.parametrize(
    ("text", "value"),
    [("level.learning_rate=1e-3", 1e-3), ("level.learning_rate=0.01", 0.01), ("level.learning_rate=2", 2)],
)
def test_numbers_are_read_as_people_write_them(text: str, value: float) -> None:
    assert settings("mh", overrides=[text]).level.learning_rate == value


def test_single_levels_can_differ() -> None:
    chosen = settings("mh", overrides=["at.3.epochs=11", "level.epochs=5"])
    assert (chosen.for_level(3).epochs, chosen.for_level(2).epochs) == (11, 5)


def test_settings_survive_json() -> None:
    chosen = settings("mh", overrides=["at.3.epochs=11", "level.mlp.widths=[8, 8]"])
    assert parse(chosen.as_dict(), "stored") == chosen


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="frozen"):
        settings("mh").seed = 3  # type: ignore[misc]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["level.epoch=3"], r"level\.epoch is not a setting; did you mean level\.epochs\? there are .*latent"),
        (["epochs=3"], r"epochs is not a setting; did you mean level\.epochs\?"),
        (["at.2.epoch=3"], r"at\.2\.epoch is not a setting; did you mean at\.2\.epochs\?"),
        ({"level": {"mlp": {"width": [3]}}}, r"level\.mlp\.width is not a setting; did you mean level\.mlp\.widths\?"),
        (["nonsense"], "expected path=value"),
        (["level.epochs=0"], r"level\.epochs = 0"),
        (["level.reduction=pca"], "'gcn', 'ae' or 'pod'"),
        (["levels=[1, 2]"], "coarse to fine"),
        (["at.3.latent=5"], "needs one size"),
        (["unified=true", "transfer.encoder=concat"], "one latent vector"),
    ],
)
def test_a_wrong_setting_is_named(overrides: list[str], message: str) -> None:
    with pytest.raises(SurrogateError, match=message):
        settings("mh", overrides=overrides)


def test_an_unknown_model_is_answered_with_the_known_ones() -> None:
    with pytest.raises(SurrogateError, match="'mhh' is not known; choose mh, podnn, aenn"):
        settings("mhh")


@pytest.mark.parametrize(("content", "message"), [("{level: [", "is no YAML"), ("- 3\n", "holds a list")])
def test_a_broken_file_is_named(tmp_path: Path, content: str, message: str) -> None:
    file = tmp_path / "broken.yaml"
    file.write_text(content)
    with pytest.raises(SurrogateError, match=rf"broken\.yaml: .*{message}"):
        settings(file=file)


def test_defaults_of_the_class_are_the_papers() -> None:
    assert Settings().level == settings("mh", "paper").level


def test_levels_that_start_from_a_coarser_one_train_for_a_share_of_the_epochs() -> None:
    chosen = settings("mh", overrides=["level.epochs=50", "transfer.epochs=0.1", "at.1.epochs=7"])
    assert chosen.for_level(3).epochs == 50
    assert chosen.for_level(2, transferred=True).epochs == 5
    assert chosen.for_level(1, transferred=True).epochs == 7


def paths(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from paths(kind, f"{prefix}{name}.")
        else:
            yield prefix + name


def test_the_documentation_names_every_setting() -> None:
    text = (Path(__file__).parents[2] / "docs" / "surrogates.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    told = set()
    for row in rows:
        names = re.findall(r"`([\w.]+)`", row)
        group = names[0].rpartition(".")[0] if names else ""
        told |= {name if "." in name or not group else f"{group}.{name}" for name in names}
    assert set(paths(Settings)) - {"model", "preset"} - told == set()


@pytest.mark.parametrize(
    "overrides",
    [
        {"level": {"epochs": 20}, "at": {2: {"latent": 3}}},
        {"level.epochs": 20, "at.2.latent": 3},
        {"level": {"epochs": 20}, "at": {"2": {"latent": 3}}},
        [["level.epochs=5", "at.2.latent=3"], {"level.epochs": 20}],
    ],
)
def test_settings_come_as_dictionaries_too(overrides: object) -> None:
    shared = {"transfer": {"encoder": "concat"}}
    chosen = settings("mh", overrides=[overrides, shared])  # type: ignore[list-item]
    assert (chosen.level.epochs, chosen.for_level(2).latent, chosen.for_level(1).latent) == (20, 3, 48)
