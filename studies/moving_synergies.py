"""Animation of a body moved by each synergy of a bundle.

    python studies/moving_synergies.py runs/NAME/synergies docs/pictures [TASK]

Each panel moves the coefficient of one synergy through +1 and -1 while the others are 0, for the
first three synergies of the bundle. No policy acts. The README's animation uses the bundle of

    python recipes/etl_sac.py env=myoHandPenTwirl stage=explore explore.frames=4000 seed=100

on TASK myoHandPose.
"""

# ruff: noqa: E402  (MuJoCo chooses how it draws when it is first imported)

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from torchrl_etl.gl_backend import draw_without_display

draw_without_display()
from torchrl_etl.analysis.animation import FPS, write_animation
from torchrl_etl.analysis.viewer import Session
from torchrl_etl.command_line import exit_on_error
from torchrl_etl.inspection import open_bundle
from torchrl_etl.training import EpisodeRecorder

SHOWN = 3
SECONDS = 2.0
SIZE = (180, 212)  # pixels of a panel


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bundle", type=Path)
    parser.add_argument("folder", type=Path, help="where the animation is written")
    parser.add_argument("task", nargs="?", help="another task than the bundle's, of the same body")
    arguments = parser.parse_args()
    with exit_on_error(ValueError, OSError, RuntimeError):
        session = Session(open_bundle(arguments.bundle, arguments.task))
        session.model.site_rgba[:, 3] = 0.0  # hide the goals of the task
        with EpisodeRecorder(session.env, size=SIZE) as recorder:
            number = min(SHOWN, len(session.coefficients))
            sides = {
                f"synergy {synergy + 1}": [moved(session, recorder, synergy)]
                for synergy in range(number)
            }
        for path in write_animation(arguments.folder, sides, "moving_synergies"):
            print(path)


def moved(session: Session, recorder: EpisodeRecorder, synergy: int) -> np.ndarray:
    session.reset(0)
    session.center()
    frames = []
    for now in np.arange(0, SECONDS, 1 / FPS):
        session.move(synergy, float(np.sin(2 * np.pi * now / SECONDS)))
        session.advance(1 / FPS, patience=10.0)
        frames.append(recorder.draw())
    return np.stack(frames)


if __name__ == "__main__":
    main()
