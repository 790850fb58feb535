"""Evaluations: the numbers of the command line, from one process, from shards, frame by frame."""

import json

import pytest

import voxcast

FRAMES = 12


def test_numbers_are_those_of_the_command_line(place, model, heldout, scores):
    told = []
    report = voxcast.evaluate(
        model, heldout, losses=True, workers=2, threads=2, progress=lambda done, total: told.append((done, total))
    )
    assert report.to_dict() == scores
    assert told[-1] == (FRAMES, FRAMES) and [done for done, _ in told] == sorted(done for done, _ in told)
    assert report.frames == FRAMES and report.miou == scores["regions"]["all"]["miou"]
    assert report.iou == scores["regions"]["all"]["iou"] and report.digests == [scores["digest"]]
    assert "mIoU" in str(report) and "| mIoU |" in report._repr_markdown_()
    report.write_json(place / "report.json")
    assert (place / "report.json").read_bytes() == (place / "scores.json").read_bytes()
    report.write_confusion(place / "confusion.png")
    assert (place / "confusion.png").read_bytes().startswith(b"\x89PNG")


def test_an_interrupt_ends_it_and_the_journal_has_what_was_done(place, model, heldout, scores):
    journal = place / "interrupted.jsonl"

    def stop(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        voxcast.evaluate(model, heldout, losses=True, resume=journal, threads=1, progress=stop)
    kept = len(journal.read_text().splitlines()) - 1
    assert 2 <= kept < FRAMES
    told = []
    report = voxcast.evaluate(
        model, heldout, losses=True, resume=journal, threads=1, progress=lambda done, total: told.append(total)
    )
    assert report.to_dict() == scores and told[-1] == FRAMES - kept


def test_shards_are_merged_and_frames_scored_one_by_one(place, model, heldout, scores):
    journals = [place / f"shard-{index}.jsonl" for index in range(3)]
    for index, journal in enumerate(journals):
        part = voxcast.evaluate(model, heldout, losses=True, shard=f"{index}/3", resume=journal, threads=1)
        assert part.frames == len(range(index, FRAMES, 3))
    assert voxcast.merge(journals).to_dict() == scores
    with pytest.raises(voxcast.MismatchError, match="shards are missing: 1/3"):
        voxcast.merge([journals[0], journals[2]])

    evaluation = voxcast.Evaluation([model], heldout, losses=True)
    worker = voxcast.Worker(evaluation, threads=1)
    lines = [worker.score(index) for index in reversed(evaluation.left)]
    # A line is that of the journal, whoever computed it.
    assert set(lines) == {line for journal in journals for line in journal.read_text().splitlines()[1:]}
    assert all(evaluation.add(line) for line in lines)
    assert not evaluation.add(lines[0]) and evaluation.left == []
    assert evaluation.report().to_dict() == scores
    first = json.loads(lines[0])
    for wrong in [{**first, "frame": "another"}, {**first, "index": FRAMES}, {**first, "digests": []}, [1]]:
        with pytest.raises(voxcast.FormatError):
            evaluation.add(json.dumps(wrong))


def test_confidence_is_fitted_and_its_calibration_counted(place, program, model, heldout):
    fitted = voxcast.calibrate_confidence(model, heldout, place / "fitted.safetensors", limit=2, threads=1)
    assert fitted.temperature > 0 and fitted.path == place / "fitted.safetensors"
    arguments = ["--data", heldout, "--limit", 2, "-o", place / "same.safetensors"]
    program("calibrate-confidence", model.path, *arguments)
    assert (place / "same.safetensors").read_bytes() == (place / "fitted.safetensors").read_bytes()
    report = voxcast.evaluate(fitted, heldout, calibration=True, limit=3, threads=2)
    calibration = report.to_dict()["calibration"]["all"]["occupied"]
    assert 0 <= calibration["expected_error"] < 0.2
    program("eval", "--model", fitted.path, "--data", heldout, "--limit", 3, "--calibration", "--json", place / "sure.json")
    assert json.loads((place / "sure.json").read_text())["calibration"]["all"]["occupied"] == calibration
    report.write_reliability(place / "reliability.png")
    assert (place / "reliability.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(voxcast.MismatchError, match="expected an evaluation with calibration"):
        voxcast.evaluate(model, heldout, limit=1).write_reliability(place / "none.png")
    with pytest.raises(ValueError, match="expected synthetic:DIR"):
        voxcast.calibrate_confidence(model, "heldout", place / "none.safetensors")


def test_two_models_are_compared(model, heldout):
    twin = voxcast.Model.from_bytes(model.to_bytes())
    report = voxcast.evaluate([model, twin], heldout, limit=2, threads=1).to_dict()
    assert report["comparison"]["equal"] == 1.0 and report["comparison"]["frames"] == 2
    assert report["reports"][0]["digest"] == report["reports"][1]["digest"]


def test_what_cannot_be_evaluated_is_refused(model, heldout, place):
    for wrong, kind, text in [
        (lambda: voxcast.evaluate([], heldout), ValueError, "models: found 0"),
        (lambda: voxcast.evaluate(model, "heldout"), ValueError, "expected synthetic:DIR"),
        (lambda: voxcast.evaluate(model, "synthetic:nowhere"), voxcast.FileError, "nowhere"),
        (lambda: voxcast.evaluate(model, heldout, shard="3/3"), voxcast.FormatError, "shard 3/3"),
        (lambda: voxcast.evaluate(model, heldout, workers=0), ValueError, "workers: found 0"),
        (lambda: voxcast.evaluate(model, heldout, limit=0), ValueError, "limit: found 0"),
        (lambda: voxcast.merge([place / "none"], limit=0), ValueError, "limit: found 0"),
        (lambda: voxcast.evaluate(model, heldout, resume=place / "model.safetensors"), voxcast.FormatError, "line 1"),
    ]:
        with pytest.raises(kind, match=text):
            wrong()
