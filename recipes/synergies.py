"""Synergies of recorded muscle activity: their number, by cross-validation, and a bundle.

    python recipes/synergies.py data=emg.csv kind=nmf num=1..8
    python recipes/synergies.py data=emg.csv leave_out=[time] normalize=true trial=subject

Column names are muscle names. All settings with their defaults:
"""

from __future__ import annotations

import csv
import hashlib
import io
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from torch import Tensor

from torchrl_etl.analysis import (
    CrossValidation,
    cross_validate,
    enough_synergies,
    synergy_heatmap,
    vaf_curve,
    variance_accounted_for,
)
from torchrl_etl.checks import (
    check_choice,
    check_flag,
    check_integer,
    check_path,
    check_real,
    check_sizes,
)
from torchrl_etl.command_line import check_overrides, exit_on_error, quote_paths
from torchrl_etl.io import write_atomically
from torchrl_etl.modules.recorded_actions import LEAST_REACH, OVERSHOOT
from torchrl_etl.synergies import (
    SYNERGY_MODELS,
    BundleError,
    Recording,
    SynergyModel,
    fit_synergies,
    read_recording,
    save_bundle,
)
from torchrl_etl.synergies.bundle_info import read_description
from torchrl_etl.user_code import find_class
from torchrl_etl.user_conf import group_files

CONF = Path(__file__).parent / "conf"
HEADER = ("synergies", "fitted", "held out", "worst fold", "best fold")


@hydra.main(version_base="1.3", config_path="conf", config_name="recording")
def main(config: DictConfig) -> None:
    with exit_on_error(ValueError, OSError):
        kind, options = kind_and_options(config)
        folder = Path(config.out or f"runs/{Path(config.data).stem}-{kind}")
        check_folder(folder)
        recording = load(config)
        digest = hashlib.sha256(Path(config.data).read_bytes()).hexdigest()
        check_recording(folder, digest)
        numbers = numbers_of_synergies(config.num, len(recording.muscles))
        trials = recording.trials
        by_trial = trials is not None and len(set(trials)) > 1

        def fit(number: int, rows: Tensor) -> SynergyModel:
            torch.manual_seed(config.seed)
            return fit_synergies(rows, kind, number, low=config.low, high=config.high, **options)

        print(
            f"{len(recording.activity):,} rows of {len(recording.muscles)} muscles; held out: "
            + (f"whole trials of {len(set(trials))}" if by_trial else "blocks of rows")
        )
        print("  ".join(f"{title:>10}" for title in HEADER))
        found, models = {}, {}
        for number in numbers:
            found[number], models[number] = cross_validate(
                lambda rows, number=number: fit(number, rows),
                recording.activity,
                folds=config.folds,
                trials=trials if by_trial else None,
            )
            print(f"{number:>10}  " + "  ".join(f"{value:>10.3f}" for value in found[number]))
        chosen = enough_synergies(found, config.vaf)
        decoded = write_results(folder, recording, models[chosen], found, digest, config)
    enough = found[chosen].held_out >= config.vaf
    print(
        f"{chosen} {'synergy accounts' if chosen == 1 else 'synergies account'} for "
        f"{found[chosen].held_out:.0%} of held-out rows"
        + ("" if enough else f"; no tested number reaches {config.vaf:.0%}")
    )
    print(f"  the bundle's decoder, limited to the bounds, for {decoded:.0%} of all rows")
    print(f"  all files   {folder}")


def kind_and_options(config: DictConfig) -> tuple[str, dict[str, Any]]:
    """Checks all settings; returns the kind of synergies and keyword arguments of its model."""
    if config.data is None:
        raise ValueError("no recording is given; pass data=FILE, a .csv, .npy or .npz file.")
    check_path(data=config.data, out=config.out)
    if not isinstance(config.leave_out, ListConfig):
        raise ValueError(
            f"leave_out is {config.leave_out!r}; it must be a list of columns, such as [time]."
        )
    check_flag(normalize=config.normalize)
    check_integer(2, folds=config.folds)
    check_integer(1, updates=config.updates)
    check_integer(0, seed=config.seed)
    check_real("[0, 1]", vaf=config.vaf)
    check_real("(-inf, inf)", low=config.low, high=config.high)
    options = OmegaConf.to_container(config.synergies, resolve=True)
    kind = options.pop("kind")
    options.pop("bundle")
    if find_class(kind, SYNERGY_MODELS, SynergyModel).updates is not None:  # it trains
        options.setdefault("updates", config.updates)
    return kind, options


def check_folder(folder: Path) -> None:
    """Reject a folder that cannot be created, before minutes of fitting."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise ValueError(
            f"{there} is a file, so out={folder} cannot be a folder; choose another one."
        )


def check_recording(folder: Path, digest: str) -> None:
    """Reject a folder with synergies of another recording, or of a run."""
    if (folder / "synergies").is_dir():
        with suppress(BundleError):  # a damaged bundle is replaced
            facts = read_description(folder / "synergies").facts
            if digest != facts.get("recording"):
                of = "another recording" if "recording" in facts else "a run"
                raise ValueError(f"{folder} holds synergies of {of}; pass out=FOLDER.")


def load(config: DictConfig) -> Recording:
    recording = read_recording(config.data, trial=config.trial, leave_out=config.leave_out)
    if config.normalize:
        largest = recording.activity.max(0)
        if not (largest > 0).all():
            muscle = recording.muscles[int((largest <= 0).argmax())]
            raise ValueError(
                f"{muscle!r} is never above 0, so its largest value cannot normalize it; rectify "
                "the recording, or leave normalize=false."
            )
        recording = recording._replace(activity=recording.activity / largest)
    margin = OVERSHOOT * (config.high - config.low)
    for bound, ends in (("low", recording.activity.min(0)), ("high", recording.activity.max(0))):
        beyond = ends < config.low - margin if bound == "low" else ends > config.high + margin
        if beyond.any():
            first = int(beyond.argmax())
            raise ValueError(
                f"{recording.muscles[first]!r} reaches {ends[first]:g}, beyond {bound}="
                f"{config[bound]:g}; pass low= and high= in the recording's units or "
                "normalize=true, or leave out columns that are not muscles with leave_out=."
            )
    largest = recording.activity.max()
    if largest - config.low < LEAST_REACH * (config.high - config.low):
        raise ValueError(
            f"no muscle is above {largest:g}, too near low={config.low:g} for a bundle with high="
            f"{config.high:g}; pass low= and high= in the recording's units, or normalize=true."
        )
    return recording


def numbers_of_synergies(num: Any, muscles: int) -> Sequence[int]:
    """The numbers in ``num`` that do not exceed the number of muscles."""
    if isinstance(num, str) and (ends := re.fullmatch(r"(\d+)\.\.(\d+)", num)):
        asked = list(range(int(ends[1]), int(ends[2]) + 1))
    else:
        asked = list(num) if isinstance(num, ListConfig) else [num]
    try:
        check_sizes(num=asked)
    except ValueError:
        raise ValueError(
            f"num is {num!r}; it must be numbers of synergies, such as 4, 1..8 or [2,4,8]."
        ) from None
    numbers = sorted({number for number in asked if number <= muscles})
    if not numbers:
        raise ValueError(f"num is {num}; it must not be above the number of muscles, {muscles}.")
    return numbers


def write_results(
    folder: Path,
    recording: Recording,
    model: SynergyModel,
    found: dict[int, CrossValidation],
    digest: str,
    config: DictConfig,
) -> float:
    """Write the table, the bundle and the plots; returns the VAF of the bundle's decoder."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("synergies", *CrossValidation._fields))
    rows.writerows((number, *found[number]) for number in found)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "vaf.csv", text.getvalue())
    activity = torch.as_tensor(recording.activity, dtype=torch.float32)
    decoder = model.decoder(activity)
    rows_again = decoder(decoder.encode(activity))
    decoded = variance_accounted_for(recording.activity, rows_again.detach())
    save_bundle(
        decoder,
        folder / "synergies",
        task=Path(config.data).stem,
        actuators=recording.muscles,
        kind=model.kind,
        facts={
            "vaf": found[model.num_synergies].fitted,
            "vaf_held_out": found[model.num_synergies].held_out,
            "vaf_decoded": decoded,
            "recording": digest,
            "rows": len(recording.activity),
            "seed": config.seed,
        },
    )
    pictures = folder / "pictures"
    synergy_heatmap(decoder, recording.muscles, pictures / "synergies.png")
    series = {
        f"{model.kind.upper()}, fitted": [of.fitted for of in found.values()],
        "held out": [of.held_out for of in found.values()],
    }
    vaf_curve(list(found), series, pictures / "vaf.png", chosen_d=model.num_synergies)
    return decoded


if __name__ == "__main__":
    arguments = sys.argv[1:]
    with exit_on_error(ValueError):
        for i, argument in enumerate(arguments):
            if argument.startswith("kind="):
                kinds = list(group_files(CONF, "synergies"))  # one's own, too
                check_choice("kind", kind := argument.removeprefix("kind="), kinds)
                arguments[i] = f"synergies={kind}"
    sys.argv[1:] = quote_paths(arguments, "data", "out")
    check_overrides(CONF / "recording.yaml", sys.argv[1:], __doc__, short=["kind"])
    main()
