"""View a body in the browser, moved by its policies or by sliders for its synergies.

    python recipes/view.py run=runs/NAME
    python recipes/view.py zoo=NAME
    python recipes/view.py bundle=runs/NAME/synergies env=myoHandPenTwirl
    ssh -L 8080:localhost:8080 MACHINE     # for a run on another machine

All settings with their defaults:
"""

from __future__ import annotations

import sys
from pathlib import Path

import hydra
from omegaconf import DictConfig

from torchrl_etl.analysis.viewer import Session, Subject
from torchrl_etl.checks import check_path
from torchrl_etl.command_line import (
    OPENING_ERRORS,
    check_overrides,
    exit_on_error,
    quiet_torchrl,
    quote_paths,
)
from torchrl_etl.inspection import open_bundle, open_run, open_zoo
from torchrl_etl.training.loop import StopOnSignal
from torchrl_etl.zoo import bundle_path

CONF = Path(__file__).parent / "conf"
SOURCES = ("run", "zoo", "bundle")


@hydra.main(version_base="1.3", config_path="conf", config_name="view")
def main(config: DictConfig) -> None:
    quiet_torchrl()
    with exit_on_error(*OPENING_ERRORS):
        from torchrl_etl.analysis.viewer.page import Page, check_port  # needs an extra

        check_port(config.host, config.port)
        session = Session(open_subject(config))
        page = Page(session, host=config.host, port=config.port, say=print)
    print(f"{session.subject.name} is shown at {page.address} (Ctrl-C to stop)", flush=True)
    with StopOnSignal() as stop:  # an exception could be lost in one of the libraries' callbacks
        page.run(until=lambda: stop.requested)
    print("The viewer has stopped.")


def open_subject(config: DictConfig) -> Subject:
    """The run, entry or bundle in the settings; exactly one must be given."""
    check_path(**{source: config[source] for source in SOURCES})
    named = [source for source in SOURCES if config[source] is not None]
    if len(named) != 1:
        raise ValueError(
            f"{' and '.join(named) or 'nothing to view'} {'were' if named else 'was'} given; "
            "pass run=PATH, the folder that etl_sac.py printed, zoo=NAME, or bundle=PATH env=TASK."
        )
    # For an entry, env= gives the module of its task, which the entry itself may not import.
    own = {"run": ["env", "goal"], "zoo": ["goal"], "bundle": []}[named[0]]
    if given := [setting for setting in own if config[setting] is not None]:
        raise ValueError(f"{named[0]} has its own task; leave {' and '.join(given)} out.")
    if named == ["zoo"]:
        return open_zoo(config.zoo, config.env)
    if named == ["run"]:
        return open_run(Path(config.run), defaults=hydra.compose("config"))
    return open_bundle(bundle_path(config.bundle), config.env, goal=config.goal)


if __name__ == "__main__":
    sys.argv[1:] = quote_paths(sys.argv[1:], *SOURCES)
    check_overrides(CONF / "view.yaml", sys.argv[1:], __doc__)
    main()
