"""Synergies of recorded muscle activity: files, cross-validation, and the command."""

from __future__ import annotations

import csv
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.commands import command
from torchrl_etl.analysis import cross_validate, held_out_rows, variance_accounted_for
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.synergies import (
    NMFSynergies,
    fit_synergies,
    load_bundle,
    read_recording,
    save_bundle,
)

MUSCLES = tuple(f"m{i}" for i in range(6))


def emg(rows: int = 240, sources: int = 3) -> np.ndarray:
    """Activity of six muscles in [0, 1], mixed from a few sources."""
    rng = np.random.default_rng(0)
    return rng.random((rows, sources)) @ rng.random((sources, 6)) / sources


def write(path, activity, names=MUSCLES, **columns):
    table = [*activity.T.tolist(), *columns.values()]
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([(*names, *columns), *zip(*table, strict=True)])
    return path


def test_csv_with_trials_and_ignored_columns_is_read(tmp_path):
    activity = emg(8)
    trials = ["walk"] * 4 + ["run"] * 4
    path = write(tmp_path / "emg.csv", activity, time=range(8), trial=trials)
    found = read_recording(path, leave_out=["time"])
    assert found.muscles == MUSCLES
    np.testing.assert_allclose(found.activity, activity)
    assert found.trials.tolist() == trials
    other = path.with_name("semicolons.csv")
    other.write_text("\ufeff" + path.read_text().replace(",", ";") + "\n\n")
    np.testing.assert_allclose(read_recording(other, leave_out=["time"]).activity, activity)
    assert read_recording(path, trial="time", leave_out=["trial"]).trials.tolist()[1] == "1"


def test_numpy_files_of_every_layout_are_read(tmp_path):
    activity, trials = emg(8), np.arange(8) // 4
    np.save(tmp_path / "plain.npy", activity)
    plain = read_recording(tmp_path / "plain.npy")
    assert plain.muscles[0] == "muscle_0" and plain.trials is None
    records = np.rec.fromarrays(activity.T, names=list(MUSCLES))
    np.save(tmp_path / "fields.npy", np.asarray(records))
    np.savez(tmp_path / "matrix.npz", emg=activity, names=np.array(MUSCLES), trial=trials)
    np.savez(tmp_path / "columns.npz", trial=trials, **dict(zip(MUSCLES, activity.T, strict=True)))
    np.savez(tmp_path / "bytes.npz", emg=activity, names=np.array(MUSCLES, "S"), trial=trials)
    (tmp_path / "renamed.npy").write_bytes((tmp_path / "matrix.npz").read_bytes())
    for name in ("fields.npy", "matrix.npz", "columns.npz", "bytes.npz", "renamed.npy"):
        found = read_recording(tmp_path / name)
        assert found.muscles == MUSCLES, name
        np.testing.assert_array_equal(found.activity, activity)
        assert (found.trials is None) == (name == "fields.npy")
    np.savez(tmp_path / "named.npz", emg=activity[:, :1], names=np.array(["großzehe".encode()]))
    assert read_recording(tmp_path / "named.npz").muscles == ("großzehe",)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a,b\n1,2\n3\n", "Line 3 of .* has 1 entries but the first line 2"),
        ("a,b\n1,2\n3,\n5,6\n", "'b' in .* has no value in line 3; fill"),
        ("a,b\n1,2\nNaN,3\n5,NA\n", "'a' in .* no value in line 3, one of 2 such places"),
        ("a,b\n1,2\n\n\nNaN,3\n5,6\n", "'a' in .* has no value in line 5;"),
        ('"a","b\n(mV)"\n1,2\nx,3\n', "'a' in .* has 'x', not a number, in line 4"),
        ("a,b\n1,2\nx,3\n", "'a' in .* has 'x', not a number, in line 3; .*leave_out=\\[a\\]"),
        ("a;b\n0,5;0,6\n", "'a' in .* decimal comma in line 2; .*0.5 instead of 0,5"),
        ("a\tb\n1\t2\n1\t-,5e-3\n", "'b' in .* decimal comma in line 3; .*-.5e-3 instead of"),
        ('a,b\n1,2\n"3,4\n5,6\n', "Line 3 of .* has unmatched quotation marks"),
        ('a,b\n1,2\n3,"4\n' + "5,6\n" * 50_000, "Line 3 of .*emg.csv .*larger than field limit"),
        ("a,b\n1,2\n1,3\n", "'a' in .* has the same value in every row; .*leave_out=\\[a\\]"),
        ("a (mV);b, left\n1;2\n1;3\n", "'a \\(mV\\)' .*with \"leave_out=\\['a \\(mV\\)'\\]\""),
        ("a,a\n1,2\n2,3\n", "2 columns 'a'"),
        (",a\n1,2\n2,3\n", "Column 1 of .* has no name"),
        ("trial,a\nx,2\n,3\n", "has no trial in line 3"),
        ("1,2\n3,4\n", "names no columns"),
        ("", "names no columns"),
        ("a,b\n1,2\n", "1 row"),
        ("trial\n1\n2\n", "no muscle columns"),
    ],
)
def test_invalid_table_is_refused(text, words, tmp_path):
    path = tmp_path / "emg.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=words):
        read_recording(path)


def test_unreadable_file_is_refused(tmp_path):
    np.save(tmp_path / "pickle.npy", np.array([{}, {}]), allow_pickle=True)
    np.save(tmp_path / "cube.npy", np.zeros((2, 3, 4)))
    np.savez(tmp_path / "two.npz", a=np.zeros((2, 3)), b=np.zeros((2, 3)))
    np.savez(tmp_path / "ragged.npz", a=np.arange(3), b=np.arange(4))
    np.savez(tmp_path / "names.npz", a=emg(4), names=np.array(["x"]))
    np.savez(tmp_path / "gap.npz", a=np.array([1.0, np.nan]), b=np.arange(2))
    np.savez(tmp_path / "trial.npz", a=np.arange(2), trial=np.array([1.0, np.nan]))
    np.savez(tmp_path / "text.npz", a=np.array(["x", "y"]), b=np.arange(2))
    np.savez(tmp_path / "trials.npz", emg=emg(4), trial=np.arange(3))
    (tmp_path / "renamed.npz").write_bytes((tmp_path / "cube.npy").read_bytes())
    whole = (tmp_path / "two.npz").read_bytes()
    first = whole.index(b"PK\x01\x02")  # of the table of contents, which counts
    for name, at, byte in (("locked", first + 8, 1), ("method", first + 10, 99)):
        (tmp_path / f"{name}.npz").write_bytes(whole[:at] + bytes([byte]) + whole[at + 1 :])
    whole_array = (tmp_path / "cube.npy").read_bytes()
    vast = whole_array.replace(b"(2, 3, 4), }    ", b"(200000000, 99999)}")
    (tmp_path / "vast.npy").write_bytes(vast)
    for name, header in (("open", b"{'descr': ('<f8',"), ("unparsed", b"{'descr' '<f8' 1")):
        start = whole_array[:10] + header
        (tmp_path / f"{name}.npy").write_bytes(start + b" " * (128 - len(start)))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "two.npz").read_bytes()[:200])
    (tmp_path / "latin.csv").write_bytes("a,\xe4\n1,2\n".encode("latin-1"))
    (tmp_path / "emg.mat").write_bytes(b"x")
    for name, words in {
        "pickle.npy": "does not hold arrays of numbers",
        "cube.npy": r"shape \(2, 3, 4\)",
        "two.npz": "has the arrays a, b; keep only the one",
        "ragged.npz": "3 and 4 rows",
        "names.npz": "1 names for the 6 columns",
        "gap.npz": "'a' in .* has no value in row 1;",
        "trial.npz": "has no trial in row 1",
        "text.npz": "'a' in .* of type",
        "trials.npz": "3 entries of 'trial' for the 4 rows of emg",
        "renamed.npz": r"shape \(2, 3, 4\)",
        "cut.npz": "does not hold arrays of numbers",
        "locked.npz": r"does not hold arrays of numbers \(.*encrypted",
        "method.npz": "does not hold arrays of numbers",
        "open.npy": "does not hold arrays of numbers",
        "unparsed.npy": "does not hold arrays of numbers",
        "vast.npy": r"does not hold arrays of numbers \(.*allocate",
        "latin.csv": "not UTF-8 text",
        "emg.mat": "pass a .csv, .npy or .npz file",
        "none.csv": "no file",
    }.items():
        with pytest.raises((ValueError, FileNotFoundError), match=words):
            read_recording(tmp_path / name)


def test_folds_keep_trials_together_and_are_balanced():
    trials = np.repeat(["a", "b", "c", "d"], [5, 1, 3, 1])
    parts = held_out_rows(10, folds=2, trials=trials)
    assert [set(trials[part]) for part in parts] == [{"a"}, {"b", "c", "d"}]
    assert sorted(np.concatenate(parts)) == list(range(10))
    assert len(held_out_rows(10, folds=9, trials=trials)) == 4
    with pytest.raises(ValueError, match="All rows belong to trial a"):
        held_out_rows(3, trials=["a"] * 3)
    for trials in ([0.0, 1.0, np.nan, 1.0], ["a", "b", None, "b"]):
        with pytest.raises(ValueError, match="Row 2 has no trial"):
            held_out_rows(4, trials=trials)


class Mean:
    """A model that reconstructs every row by the mean of the rows it was fitted to."""

    def __init__(self, rows):
        self.mean = rows.mean(0)

    def reconstruct(self, rows):
        return self.mean.expand_as(rows)


def test_held_out_vaf_is_of_models_fitted_without_the_rows():
    rows = np.array([[0.0], [2.0], [4.0], [6.0]])
    found, model = cross_validate(Mean, rows, folds=2)
    # Fitted: the mean explains nothing. Held out: 5 predicts 0 and 2, and 1 predicts 4 and 6,
    # with squared errors of 25 + 9 + 9 + 25 against a variance of 20.
    assert found.fitted == 0.0
    assert found.held_out == pytest.approx(1 - 68 / 20)
    assert found.lowest == found.highest == pytest.approx(1 - 34 / 10)
    assert model.mean.item() == 3.0


def test_fold_of_one_row_has_a_defined_vaf():
    rows = np.array([[0.0], [3.0], [6.0], [7.0]])
    found, _ = cross_validate(Mean, rows, folds=4)
    # Squares about the mean of all rows, 4: 16, 1, 4 and 9. Each row is predicted by the mean of
    # the other three: 16/3, 13/3, 10/3 and 3.
    assert found.lowest == pytest.approx(1 - (16 / 9))
    assert found.highest == pytest.approx(1 - (16 / 9))
    row = emg(4, sources=1)
    found, _ = cross_validate(lambda rows: fit_synergies(rows, "pca", 1, low=0.0), row, folds=4)
    assert 0.0 < found.lowest < found.highest < 1.0


@pytest.mark.parametrize("kind", ["nmf", "pca"])
def test_held_out_vaf_identifies_three_sources(kind):
    activity = torch.as_tensor(emg(), dtype=torch.float32)
    vaf = [
        cross_validate(lambda rows, d=d: fit_synergies(rows, kind, d, low=0.0), activity)[0]
        for d in (1, 2, 3)
    ]
    assert vaf[0].held_out < vaf[1].held_out < 0.98 < vaf[2].held_out
    assert all(of.lowest <= of.held_out <= of.highest for of in vaf)


def test_command_writes_table_bundle_and_pictures(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path / "emg.csv", emg(), trial=[i // 60 for i in range(240)])
    settings = ("kind=nmf", "num=2..9", "vaf=0.98", "out=found")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert command("synergies.py", f"data={path}", *settings) == 0
    said = capsys.readouterr().out
    assert "240 rows of 6 muscles; held out: whole trials of 4" in said
    assert "3 synergies account for 100% of held-out rows" in said
    folder = tmp_path / "found"
    with (folder / "vaf.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["synergies"] for row in table] == list("23456")  # there are six muscles
    decoder, info = load_bundle(folder)
    assert (info.kind, info.actuators, info.num_synergies) == ("nmf", MUSCLES, 3)
    assert info.facts["vaf_held_out"] == pytest.approx(float(table[1]["held_out"]))
    with torch.no_grad():
        decoded = variance_accounted_for(emg(), decoder(decoder.encode(emg())))
    assert info.facts["vaf_decoded"] == pytest.approx(decoded, abs=1e-4) and decoded > 0.9
    assert f"the bundle's decoder, limited to the bounds, for {decoded:.0%} of all rows" in said
    for name in ("synergies.png", "vaf.png"):
        assert (folder / "pictures" / name).stat().st_size > 5_000


def test_synergies_of_another_recording_or_a_run_are_not_overwritten(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for subject, rows in (("S01", 40), ("S02", 50)):
        Path(subject).mkdir()
        write(Path(subject) / "emg.csv", emg(rows))
    first, second = (["synergies.py", f"data=S0{i}/emg.csv", "kind=pca", "num=2"] for i in (1, 2))
    assert command(*first) == 0 and command(*first, "num=3") == 0  # the same one again
    before = Path("runs/emg-pca/vaf.csv").read_bytes()
    assert command(*second) == 2
    assert "runs/emg-pca holds synergies of another recording; pass out=" in capsys.readouterr().err
    assert Path("runs/emg-pca/vaf.csv").read_bytes() == before
    of_a_run = save_bundle(SynergyDecoder(1, 2), "run/synergies", task="toy", actuators=["a", "b"])
    assert command(*first, "out=run") == 2
    assert "run holds synergies of a run; pass out=FOLDER" in capsys.readouterr().err
    assert load_bundle(of_a_run)[1].task == "toy"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["kind=nmff"], "kind is 'nmff'; choose one of"),
        (["num=0"], "num is 0; it must be numbers of synergies"),
        (["num=a..b"], "num is 'a..b'"),
        (["num=[7,8]"], "not be above the number of muscles, 6"),
        (["high=0.5"], "beyond high=0.5; pass low= and high="),
        (["high=1000"], "too near low=0 for a bundle with high=1000; pass low="),
        (["trial=subject"], "no column 'subject'"),
        (["leave_out=m0"], "leave_out is 'm0'; it must be a list"),
        (["data=null"], "no recording is given"),
        (["data=other.csv"], "no file"),
        (["data=[a.csv,b.csv]"], "data is ['a.csv', 'b.csv']; it must be one path"),
        (["normalise=true"], "did you mean normalize"),
        (["knd=nmf"], "did you mean kind"),
        (["out=emg.csv"], "emg.csv is a file, so out=emg.csv cannot be a folder"),
        (["out=emg.csv/new"], "emg.csv is a file, so out=emg.csv/new cannot be a folder"),
    ],
)
def test_invalid_setting_of_the_command_is_refused(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path / "emg.csv", emg(20))
    assert command("synergies.py", f"data={path}", *arguments) != 0
    assert words in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["emg.csv"]


def test_ctrl_c_is_no_traceback_and_leaves_nothing(tmp_path, monkeypatch, capsys):
    def interrupt(*given, **options):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(NMFSynergies, "fit", interrupt)
    path = write(tmp_path / "emg.csv", emg(20))
    assert command("synergies.py", f"data={path}", "kind=nmf", "num=2") == 130
    assert capsys.readouterr().err == "Stopped.\n"
    assert [file.name for file in tmp_path.iterdir()] == ["emg.csv"]
