"""The page on a run."""

import base64
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from eisp_data.errors import ConfigError, DataError
from finetune.report import write_report
from finetune.results import percent
from finetune.video import film_length, middle_frame, write_video

VOID = {"meta", "br"}


class Strict(HTMLParser):
    """Collects tags and text; every tag must be closed, and nothing may come from outside."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open, self.tags, self.words = [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        for name, value in attrs:
            assert name not in ("src", "href") or value.startswith("data:")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def evaluation(success, value):
    def around(mean, half):
        return {"mean": mean, "low": mean - half, "high": mean + half}

    return {
        "task": "stack",
        "episodes": 100,
        "seed": 1000,
        "success_last": around(success, 0.09),
        "success_any": around(success + 0.05, 0.08),
        "return": around(value, 10.0),
        "relative_return": around((value + 300) / 244.6, 0.04),
        "oracle_return": -55.4,
        "paper_return": -89.29,
        "subgoal_distance": {
            "edges": [0.0, 0.1, 0.2],
            "failures": [7, 0, 2],
            "successes": [80, 11, 0],
        },
    }


@pytest.fixture
def run_dir(tmp_path):
    """A whole run, as small as can be."""
    lines = [
        {"stage": "pretrain", "updates": n, "env_steps": 0, "wall_s": 30.0 * n,
         "held_out/log_likelihood": float(n), "held_out/hits": 0.1 * n}
        for n in (1, 2, 4)
    ] + [
        {"stage": "finetune", "updates": n, "env_steps": 1000 * n, "wall_s": 60.0 * n,
         "eval/success_last": s, "eval/success_any": s, "eval/return": -200 + 100 * s}
        for n, s in enumerate((0.5, 0.4, 0.6, 0.8))
    ]  # fmt: skip
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (tmp_path / "metrics.jsonl").write_text(text + '{"stage": "finetu')
    (tmp_path / "evaluation_before.json").write_text(json.dumps(evaluation(0.5, -150.0)))
    (tmp_path / "evaluation_after.json").write_text(json.dumps(evaluation(0.81, -92.0)))
    (tmp_path / "finetune.yaml").write_text("task: stack # <b>\n")
    frames = np.random.default_rng(0).integers(0, 255, (6, 48, 64, 3), np.uint8)
    write_video(tmp_path / "episode.mp4", frames, 25)
    return tmp_path


def page_of(run_dir):
    return Strict(write_report(run_dir).read_text())


def test_the_page_is_whole_and_needs_nothing_from_outside(run_dir):
    page = page_of(run_dir)
    tags = [tag for tag, _ in page.tags]
    assert tags.count("table") == 1
    assert tags.count("video") == 1
    assert tags.count("svg") == 7
    assert "script" not in tags and "link" not in tags


def test_the_table_has_the_figures_with_their_intervals(run_dir):
    text = " ".join("".join(page_of(run_dir).words).split())
    for figure in ("81% [72%, 90%]", "50% [41%, 59%]", "−92.0 [−102.0, −82.0]", "−89.3", "−55.4"):
        assert figure in text
    # The paper's return of -89.29 beside the oracle's -55.4, of 300 steps.
    assert f"{(300 - 89.29) / (300 - 55.4):.0%}" in text


def test_of_another_environment_it_says_nothing_that_holds_of_ours_alone(run_dir):
    text = " ".join("".join(page_of(run_dir).words).split())
    assert "Eq. (1)" in text and "pretrained offline on recorded episodes, then fine-tuned" in text
    for name in ("evaluation_before.json", "evaluation_after.json"):
        foreign = evaluation(0.5, -20.0) | {"task": "FetchReach-v4"}
        foreign |= dict.fromkeys(("oracle_return", "paper_return", "relative_return"))
        (run_dir / name).write_text(json.dumps(foreign))
    lines = (run_dir / "metrics.jsonl").read_text().splitlines(keepends=True)
    online = [line for line in lines if '"finetune"' in line]
    (run_dir / "metrics.jsonl").write_text("".join(online))
    text = " ".join("".join(page_of(run_dir).words).split())
    assert "Eq. (1)" not in text and "the environment's own" in text
    assert "It was trained online in simulation." in text


def test_the_dip_and_the_recovery_are_told(run_dir):
    text = "".join(page_of(run_dir).words)
    assert "Going online first cost 10 points of the 50% at the start" in text
    assert "2,000 environment steps later it had recovered" in text


def test_fine_tuning_comes_after_pretraining_on_the_clock(run_dir):
    """120 s of pretraining and 180 s of fine-tuning end at minute 5."""
    circles = re.findall(
        r"success at the last step: 0.8 at ([\d.]+)", write_report(run_dir).read_text()
    )
    assert sorted(map(float, circles)) == [5.0, 3000.0]


def test_the_film_is_in_the_page_as_it_was(run_dir):
    (film,) = [attributes for tag, attributes in page_of(run_dir).tags if tag == "video"]
    data = base64.b64decode(film["src"].partition("base64,")[2])
    assert data == (run_dir / "episode.mp4").read_bytes()
    assert base64.b64decode(film["poster"].partition("base64,")[2])[:3] == b"\xff\xd8\xff"


def test_text_from_files_is_escaped(run_dir):
    text = write_report(run_dir).read_text()
    assert "# &lt;b&gt;" in text


PARTS = ["metrics.jsonl", "evaluation_before.json", "evaluation_after.json", "finetune.yaml"]


@pytest.mark.parametrize("missing", [*PARTS, "episode.mp4"])
def test_a_missing_part_is_left_out(run_dir, missing):
    (run_dir / missing).unlink()
    page = page_of(run_dir)
    assert ("video" in [tag for tag, _ in page.tags]) == (missing != "episode.mp4")


def test_unknown_figures_are_left_out(run_dir):
    plain = evaluation(0.5, -20.0) | {"task": "FetchPush-v4", "oracle_return": None}
    plain |= {"paper_return": None, "relative_return": None}
    for name in ("before", "after"):
        (run_dir / f"evaluation_{name}.json").write_text(json.dumps(plain))
    text = "".join(page_of(run_dir).words)
    assert "The paper" not in text and "Oracle" not in text


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="nothing to report on"):
        write_report(tmp_path)
    with pytest.raises(ConfigError, match="no such folder"):
        write_report(tmp_path / "none")


def test_a_damaged_evaluation_is_named(run_dir):
    (run_dir / "evaluation_after.json").write_text("{")
    with pytest.raises(DataError, match=r"evaluation_after\.json"):
        write_report(run_dir)


def test_an_evaluation_that_has_not_finished_is_left_out_with_a_word(run_dir, tmp_path):
    (run_dir / "evaluation_after.json").write_text("")
    text = "".join(page_of(run_dir).words)
    assert "evaluation_after.json is empty: its eisp-eval has not finished" in text
    assert "50% [41%, 59%]" in text
    (run_dir / "evaluation_before.json").write_text("\n")
    text = "".join(page_of(run_dir).words)
    assert "There is no evaluation in this run. evaluation_before.json is empty" in text
    (run_dir / "metrics.jsonl").unlink()
    with pytest.raises(ConfigError, match=r"evaluation_after\.json are missing or empty"):
        write_report(run_dir)


def test_a_damaged_film_is_named(run_dir):
    (run_dir / "episode.mp4").write_bytes(b"no film")
    with pytest.raises(DataError, match=r"episode\.mp4"):
        write_report(run_dir)


def test_a_film_has_its_frames_and_a_format_that_browsers_play(tmp_path):
    import av

    frames = np.zeros((9, 49, 65, 3), np.uint8)  # odd sizes
    assert write_video(tmp_path / "film.mp4", frames, 25) == 9
    with av.open(str(tmp_path / "film.mp4"), "r") as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert (stream.height, stream.width) == (48, 64)
        assert len(list(container.decode(stream))) == 9
    data = (tmp_path / "film.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")
    assert middle_frame(data)


def test_a_film_ends_a_second_after_the_goal_is_reached_for_good():
    assert film_length([False] * 40) == 40
    assert film_length([False] * 10 + [True] * 90) == 35
    assert film_length([True] * 5 + [False] * 5 + [True] * 10) == 20


def test_a_share_is_not_rounded_up_to_all():
    shown = [percent(value) for value in (0.0, 0.5, 0.985, 0.998, 1.0, -0.02)]
    assert shown == ["0%", "50%", "98%", "99.8%", "100%", "−2%"]
