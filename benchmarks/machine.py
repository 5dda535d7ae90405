"""The machine of a measurement: its processor and its load."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

__all__ = ["machine", "on_one_core"]

LOAD_AT_START = round(os.getloadavg()[0], 2)


def machine(cpuinfo: Path = Path("/proc/cpuinfo")) -> dict[str, Any]:
    """Processor, its instruction sets for matrix products, and the load at the start."""
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
    """Pin this process, and those that it starts afterwards, to one core if possible.

    Libraries whose number of threads cannot be set then use one.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
