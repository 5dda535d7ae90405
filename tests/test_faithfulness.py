"""docs/faithfulness.md is complete, agrees with the configuration and names existing tests."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from tests.configs import CONF, ROOT
from tests.stages import explorer, fill, prepared, update
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.training import run_alone

PAGE = (ROOT / "docs" / "faithfulness.md").read_text(encoding="utf-8")
TEST = re.compile(r"(tests/\w+\.py)::(\w+)")
SETTING = re.compile(r"`(\+?(?:explore|exploration|synergies|learn)\.[\w.]+=[\w.]+)`")


def owners() -> Iterator[tuple[str, str]]:
    """(file, class or function) of every docstring that says ``Deviates:``."""
    for path in sorted((ROOT / "torchrl_etl").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and "Deviates:" in (
                ast.get_docstring(node) or ""
            ):
                yield path.relative_to(ROOT).as_posix(), node.name


def rows() -> list[list[str]]:
    """Cells of the rows of the tables that have a column of tests."""
    cells = [
        [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        for line in PAGE.splitlines()
        if line.startswith("|")
    ]
    return [
        row for row in cells if len(row) == 7 and not set(row[0]) <= {"-"} and row[0] != "Place"
    ]


def flat(config: DictConfig, prefix: str = "") -> Iterator[str]:
    for key, value in config.items():
        if isinstance(value, DictConfig):
            yield from flat(value, f"{prefix}{key}.")
        else:
            typed = json.dumps(value) if value is None or isinstance(value, bool) else value
            yield f"{prefix}{key}={typed}"


def explored(*overrides: str) -> Explorer:
    found = explorer(*overrides)
    fill(found.stage, 4)
    found.stage.close()
    return found


@pytest.mark.parametrize(("file", "owner"), list(owners()), ids=lambda value: value)
def test_every_deviation_in_the_code_has_a_row(file, owner):
    assert any(f"`{owner}`" in row[5] for row in rows()), f"{owner} of {file} is not on the page"


def test_every_deviates_note_is_in_a_docstring():
    found = sum(
        path.read_text(encoding="utf-8").count("Deviates:")
        for path in (ROOT / "torchrl_etl").rglob("*.py")
    )
    assert found == len(list(owners())), "Deviates: stands outside a docstring"


def test_every_row_is_complete_and_names_existing_tests():
    assert len(rows()) > 20
    for row in rows():
        named = TEST.findall(row[6])
        assert all(row[index] for index in (0, 1, 3, 4, 5)) and named, row[0]
        for file, test in named:
            text = (ROOT / file).read_text(encoding="utf-8")
            assert re.search(rf"^\s*(def|class) {test}\b", text, re.MULTILINE), f"{file}::{test}"


def test_every_setting_of_the_paper_preset_is_on_the_page():
    preset = OmegaConf.load(CONF / "faithful" / "paper.yaml")
    selected = set(flat(preset))
    listed = {
        s.lstrip("+") for s in SETTING.findall(PAGE.split("## What `faithful=paper` selects")[1])
    }
    assert listed == selected
    in_rows = {s.lstrip("+") for row in rows() for s in SETTING.findall(row[4])}
    assert selected <= in_rows


@pytest.mark.parametrize("setting", sorted({s for row in rows() for s in SETTING.findall(row[4])}))
def test_every_setting_on_the_page_is_accepted_as_written(setting):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        compose("config", overrides=[setting])


def test_paper_preset_configures_bonus_regularizer_and_relabeling():
    paper = explored("faithful=paper")
    update(paper.stage)
    (relabel,), (bonus,) = paper.relabel, paper.stage.learner.objective.transforms
    assert bonus.deviation is None
    assert paper.stage.learner.objective.terms[0].loss.regularizer == "literal"
    assert relabel.share == 0
    kept = paper.stage.buffer.storage[:]
    assert ((kept["direction"] == 0) | (kept["direction"] == 1)).all()
    torch.testing.assert_close(paper.actions(), kept["action"])


def test_embedding_dim_defaults_to_num_synergies():
    assert explored("num_synergies=3").exploration.encoder.embedding_dim == 3
    other = explored("num_synergies=3", "exploration.encoder.embedding_dim=5")
    assert other.exploration.encoder.embedding_dim == 5
    assert other.stage.buffer.storage[:]["direction"].shape[-1] == 5


def test_stage_1_metric_reads_the_task_reward_and_not_the_bonus():
    stage = explored().stage
    batch = prepared(stage)
    objective = stage.learner.objective

    def metric_and_critic(key: str, factor: float) -> tuple[float, float]:
        changed = batch.clone()
        changed["next", key] = factor * changed["next", key]
        torch.manual_seed(0)
        metric = objective.terms[0].loss(changed)["loss_metric"].item()
        torch.manual_seed(0)
        return metric, objective.sac(changed)["loss_qvalue"].item()

    metric, critic = metric_and_critic("reward", 1.0)
    with_reward, with_bonus = (
        metric_and_critic("reward", 9.0),
        metric_and_critic("intrinsic_reward", 9.0),
    )
    assert with_reward[0] != metric and with_reward[1] == critic
    assert with_bonus[0] == metric and with_bonus[1] != critic


@pytest.mark.parametrize(("updates", "trained"), [(0, False), (3, True)])
def test_gmvae_gets_final_updates_after_the_last_frame_unless_zero(updates, trained):
    found = explored(f"explore.fit.final_updates={updates}")
    before = found.model.model.prior_loc.clone()
    run_alone(found.condense())
    assert (not torch.equal(found.model.model.prior_loc, before)) is trained


def test_stage_1_entropy_target_is_that_of_action_std_or_sacs_usual():
    usual = explored("explore.sac.action_std=null").stage.learner.objective.sac.target_entropy
    assert usual.item() == pytest.approx(-16.0)
    # 16 muscles, each ln(0.15 * sqrt(2 * pi * e)).
    assert explored().stage.learner.objective.sac.target_entropy.item() == pytest.approx(
        16 * -0.47818, abs=1e-3
    )
