import pytest
from command_line import asked_for_json

from madoc.commands.main import main


def test_a_run_leaves_its_page(whole):
    text = (whole / "report.html").read_text()
    assert [
        id for id in ("estimates", "curves", "policies", "cost", "asked") if f'<section id="{id}">' not in text
    ] == []


def test_one_run_is_shown_and_two_are_compared(whole, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told, code = asked_for_json(capsys, ["report", whole, "--out", "one.html"])
    assert (code, told["page"]) == (0, "one.html")
    told, code = asked_for_json(capsys, ["report", whole, whole / "calibration"])
    assert (code, told["page"]) == (0, "comparison.html")
    assert "2 runs" in (tmp_path / "comparison.html").read_text()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nowhere"], "there is no run folder nowhere"),
        (["{whole}/policy-calibrated"], "holds a policy, not a calibration"),
        (["{whole}", "--out", "{whole}/data.npz"], "is no page of madoc report"),
        ([], "expected a run folder"),
    ],
)
def test_mistakes_are_answered_with_a_sentence(whole, capsys, words, sentence):
    assert main(["report", *(word.format(whole=whole) for word in words)]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and sentence in told
