"""The machine that a figure was measured on: its processor, and how busy it was."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

__all__ = ["machine", "on_one_core"]

LOAD_AT_START = round(os.getloadavg()[0], 2)


def machine(cpuinfo: Path = Path("/proc/cpuinfo")) -> dict[str, Any]:
    """Processor, the instructions that matrix products gain from, and the load at the start."""
    try:
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        lines = []
    pairs = [line.split(":", 1) for line in lines if ":" in line]
    fields = {name.strip(): value.strip() for name, value in pairs}
    flags = fields.get("flags", fields.get("Features", "")).split()
    has = {name: name in flags for name in ("avx2", "avx512f", "avx512_bf16")}
    has["amx"] = any(flag.startswith("amx") for flag in flags)
    cpu = fields.get("model name", platform.processor())
    return {"cpu": cpu, "cpu_flags": has, "load_at_start": LOAD_AT_START}


def on_one_core() -> None:
    """Keep this process, and those that it starts from now on, on one core where that is possible.

    Libraries that take no number of threads from outside then make one.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
