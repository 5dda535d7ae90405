"""The page in the browser: a session's body, with buttons and sliders."""

from __future__ import annotations

import contextlib
import io
import queue
import socket
import time
from collections.abc import Callable
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any

import torch

from torchrl_etl.analysis.pictures import synergy_heatmap
from torchrl_etl.analysis.viewer.body import Body
from torchrl_etl.analysis.viewer.html import activation_grid, driven_list, status
from torchrl_etl.analysis.viewer.muscles import activations, driven_muscles
from torchrl_etl.analysis.viewer.session import Session
from torchrl_etl.envs import SimulationError
from torchrl_etl.envs.tasks import Goal
from torchrl_etl.extras import extra

with extra("viewer"):
    import imageio.v2 as imageio
    import viser

__all__ = ["Page", "check_port"]

_FRAME = 1 / 30  # seconds between frames
_REFRESH = 0.1  # seconds between updates of the numbers
_SPEEDS = ("1/8x", "1/4x", "1/2x", "1x", "2x", "4x")
_NAMES = {"policy": "Trained policy", "sliders": "Sliders", "explorer": "Stage 1's policy"}


def check_port(host: str, port: int) -> None:
    """Raise a ``ValueError`` if the port cannot be used; viser would silently use another."""
    if not isinstance(host, str) or not host:  # an empty host would listen on all interfaces
        raise ValueError(
            f"host is {host!r}; it must be an address to listen on, such as 127.0.0.1 (for this "
            "machine alone) or 0.0.0.0 (for any machine that can reach it)."
        )
    if not isinstance(port, int) or isinstance(port, bool) or not 0 <= port <= 65535:
        raise ValueError(
            f"port is {port!r}; it must be a whole number from 0 (any free one) to 65535."
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise ValueError(
                f"The viewer cannot listen on host={host} port={port} ({error.strerror}); pass "
                "another port, or port=0 for any free one."
            ) from error


class Page:
    """Serves a session, entirely in the thread that calls :meth:`run` or :meth:`tick`.

    Args:
        session (Session): the session to show.

    Keyword Args:
        host (str): address to listen on. Default: ``"127.0.0.1"``, only this machine.
        port (int): port to listen on; 0 takes any free one. Default: 8080.
        say (callable): receives messages for the user, one line each.

    Raises:
        ValueError: if host or port cannot be used, or the session has no body to draw.
    """

    def __init__(
        self,
        session: Session,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        if session.model is None:
            raise ValueError(
                f"{session.subject.task.name} does not run on MuJoCo, so there is no body to draw; "
                "choose a task that does."
            )
        check_port(host, port)
        self.session, self._say = session, say
        self._commands: queue.SimpleQueue[Callable[[], Any]] = queue.SimpleQueue()
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
            self.server = viser.ViserServer(host, port, label="torchrl_etl", verbose=False)
        self.port = self.server.get_port()
        self.address = f"http://{f'[{host}]' if ':' in host else host}:{self.port}"
        self._shown_at = self._refreshed_at = 0.0
        self._dirty = True
        gui = self.server.gui
        # Sharing would send the page through viser's server.
        gui.configure_theme(show_logo=False, show_share_button=False)
        self._controls: dict[str, Any] = {}
        self._sliders: list[Any] = []
        self._add_controls()
        if session.subject.decoder is not None:
            self._add_synergies()
        self._make_body()
        self.server.on_client_disconnect(lambda client: self._commands.put(self._browser_left))

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Serve until ``until()`` is true, or an exception such as an interrupt."""
        last = time.monotonic()
        try:
            while not until():
                now = time.monotonic()
                self.tick(now - last)
                last = now
                time.sleep(0.005)
        finally:
            self.close()

    def tick(self, seconds: float) -> None:
        """Execute user commands, advance the session by ``seconds``, and update the page."""
        self._obey()
        try:
            self._dirty |= self.session.advance(seconds) > 0
        except SimulationError as error:
            self._stop_for(error)
        now = time.monotonic()
        if self._dirty and now - self._shown_at > _FRAME:
            self._dirty, self._shown_at = False, now
            self.body.draw()
            self._stale = True
        if self._stale and now - self._refreshed_at > _REFRESH:
            self._stale, self._refreshed_at = False, now
            self._refresh()

    def close(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
        self.session.close()

    # Commands: callbacks run in viser's threads and only queue them -----------------------------

    def _obey(self) -> None:
        while True:
            try:
                command = self._commands.get_nowait()
            except queue.Empty:
                return
            try:
                command()
            except (ValueError, SimulationError) as error:
                self._stop_for(error)
            self._dirty = self._stale = True

    def _when(self, handle: Any, command: Callable[[Any], Any]) -> Any:
        """Queue the command with the handle's value when the user changes it, not the program."""

        def changed(event: Any) -> None:
            if event.client is not None:
                self._commands.put(partial(command, event.target.value))

        (handle.on_click if hasattr(handle, "on_click") else handle.on_update)(changed)
        return handle

    def _stop_for(self, error: Exception) -> None:
        self.session.playing, self._dirty = False, True
        self._controls["message"].content = f"**{error}** Press Reset to continue."
        self._say(f"Error: {error}")

    def _browser_left(self) -> None:
        if not self.server.get_clients():
            self.session.playing = False
            self._say(
                f"The browser was closed; the viewer still runs at {self.address} (Ctrl-C to stop)."
            )

    # Controls -----------------------------------------------------------------------------------

    def _add_controls(self) -> None:
        gui, session, add = self.server.gui, self.session, self._controls
        gui.main_panel.dock_right()
        add["status"] = gui.add_html("")
        add["message"] = gui.add_markdown("")
        add["play"] = self._when(gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY), self._play)
        step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT)
        self._when(step, lambda _: session.step())
        reset = gui.add_button("Reset", icon=viser.Icon.REFRESH)
        self._when(reset, lambda _: self._reset(session.episode))
        speed = gui.add_dropdown("Speed", _SPEEDS, initial_value="1x")
        self._when(speed, self._set_speed)
        names = [_NAMES[driver] for driver in session.subject.drivers]
        add["driver"] = self._when(gui.add_dropdown("Moved by", names), self._drive)
        episode = gui.add_number("Episode", 0, min=0, step=1, hint="Its seed: start and goal.")
        add["episode"] = self._when(episode, lambda number: self._reset(int(number)))
        if len(session.subject.task.goals) > 1:
            goals = session.subject.task.goals
            goal = gui.add_dropdown("Goal", goals, initial_value=session.goal)
            add["goal"] = self._when(goal, self._choose_goal)
        if session.has_residual:
            residual = gui.add_checkbox("Residual", True, hint="Also move muscles directly")
            self._when(residual, partial(setattr, session, "residual"))
        if session.root is not None and session.subject.decoder is not None:
            hold = gui.add_checkbox("Hold the body", True, hint="While the sliders move it")
            self._when(hold, partial(setattr, session, "hold"))
        if session.subject.direction_dim:
            self._add_directions()
        with gui.add_folder("Activation"):
            add["activation"] = gui.add_html("")

    def _add_directions(self) -> None:
        gui, size = self.server.gui, self.session.subject.direction_dim
        axes = {
            f"{sign}{axis + 1}": torch.eye(size)[axis] * (1 if sign == "+" else -1)
            for axis in range(size)
            for sign in "+−"
        }

        def choose(name: str) -> None:
            self.session.follow(axes[name] if name in axes else torch.randn(size))
            direction.value = name

        hint = "The direction in which stage 1's policy explores"
        direction = self._when(gui.add_dropdown("Direction", [*axes, "random"], hint=hint), choose)
        # A menu only reports changes, so choosing "random" again would draw nothing.
        self._when(gui.add_button("New random direction"), lambda _: choose("random"))

    def _add_synergies(self) -> None:
        gui, session = self.server.gui, self.session
        decoder, names = session.subject.decoder, session.subject.actuators
        panel = gui.add_panel()
        with panel.add_tab("Synergies", viser.Icon.ADJUSTMENTS):
            gui.add_image(_heat_map(session), label="Actuators that each synergy moves")
            self._when(gui.add_button("Set all to 0"), lambda _: session.center())
            for number, muscles in enumerate(driven_muscles(decoder, names)):
                slider = gui.add_slider(
                    f"{number + 1}", min=-1.0, max=1.0, step=0.01, initial_value=0.0
                )
                self._sliders.append(self._when(slider, partial(session.move, number)))
                gui.add_html(driven_list(muscles))
        panel.dock_left()
        panel.set_width(360)

    def _play(self, _: Any) -> None:
        self.session.playing = not self.session.playing

    def _reset(self, episode: int) -> None:
        self._controls["message"].content = ""
        self.session.reset(episode)

    def _set_speed(self, name: str) -> None:
        above, _, below = name.removesuffix("x").partition("/")
        self.session.speed = float(above) / float(below or 1)

    def _drive(self, name: str) -> None:
        self.session.drive(next(driver for driver, shown in _NAMES.items() if shown == name))

    def _choose_goal(self, goal: Goal) -> None:
        self.session.choose_goal(goal)
        self._make_body()

    def _make_body(self) -> None:
        session = self.session
        follow = session.root is not None
        self.body = Body(self.server, session.model, session.data, follow=follow)
        self._stale = True

    def _refresh(self) -> None:
        """Update the numbers and sliders."""
        session, controls = self.session, self._controls
        controls["status"].content = status(session)
        active = activations(session.model, session.data)
        names = session.subject.actuators
        if len(names) == len(active):
            controls["activation"].content = activation_grid(names, active)
        controls["driver"].value = _NAMES[session.driver]
        controls["episode"].value = session.episode
        if "goal" in controls:  # reverts a goal that could not be built
            controls["goal"].value = session.goal
        controls["play"].label = "Pause" if session.playing else "Play"
        icon = viser.Icon.PLAYER_PAUSE if session.playing else viser.Icon.PLAYER_PLAY
        controls["play"].icon = icon
        if self._commands.empty():  # otherwise the user is moving a slider
            for slider, value in zip(self._sliders, session.coefficients.tolist(), strict=True):
                slider.value = round(value, 2)


def _heat_map(session: Session) -> Any:
    with TemporaryDirectory() as folder:
        picture = synergy_heatmap(
            session.subject.decoder, session.subject.actuators, f"{folder}/synergies.png", title=" "
        )
        return imageio.imread(picture)[..., :3]
