"""The log of a run: whole lines, and none twice after a resume."""

import json
import time
from pathlib import Path

from eisp_data.runs.metrics import MetricsLog, Speeds


def lines_of(run: Path) -> list[tuple[str, int]]:
    lines = (run / "metrics.jsonl").read_text().splitlines()
    return [(entry["stage"], entry["updates"]) for entry in map(json.loads, lines)]


def write(run: Path, stage: str, done: int, updates: list[int]) -> None:
    log = MetricsLog(run, stage, done)
    for update in updates:
        log.write(update, 10 * update, 0.12345, {"loss": update / 2})
    log.close()


def test_a_line_says_stage_updates_steps_time_and_values(tmp_path):
    write(tmp_path, "pretrain", 0, [3])
    [line] = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert json.loads(line) == {
        "stage": "pretrain", "updates": 3, "env_steps": 30, "wall_s": 0.123, "loss": 1.5,
    }  # fmt: skip
    assert list(tmp_path.glob("events.out.tfevents.*"))


def test_a_resumed_run_drops_what_it_does_again(tmp_path):
    write(tmp_path, "pretrain", 0, [10, 20, 30])
    write(tmp_path, "pretrain", 20, [30, 40])
    assert [updates for _, updates in lines_of(tmp_path)] == [10, 20, 30, 40]


def test_a_stage_leaves_the_lines_of_another(tmp_path):
    write(tmp_path, "pretrain", 0, [10, 20])
    write(tmp_path, "finetune", -1, [0, 5])
    write(tmp_path, "finetune", 0, [5])
    pretrained = [("pretrain", 10), ("pretrain", 20)]
    assert lines_of(tmp_path) == [*pretrained, ("finetune", 0), ("finetune", 5)]
    write(tmp_path, "finetune", -1, [0])
    assert lines_of(tmp_path) == [*pretrained, ("finetune", 0)]


def test_a_line_that_a_kill_cut_off_is_dropped(tmp_path):
    write(tmp_path, "pretrain", 0, [10])
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"stage": "pretrain", "upda')
    write(tmp_path, "pretrain", 10, [20])
    assert lines_of(tmp_path) == [("pretrain", 10), ("pretrain", 20)]


def test_speeds_are_those_of_each_part_alone_and_since_they_were_taken():
    speeds = Speeds()
    for _ in range(2):
        with speeds.measured("slow", 1):
            time.sleep(0.02)
        with speeds.measured("fast", 1000):
            pass
    taken = speeds.taken()
    assert taken["slow_per_s"] <= 50 and taken["fast_per_s"] > 10 * taken["slow_per_s"]
    assert speeds.taken() == {}
