"""Print the paper's tasks: names, ids, goals, actuators and episode lengths.

python recipes/list_tasks.py         # the table
python recipes/list_tasks.py names   # one name a line, for scripts
"""

from __future__ import annotations

import sys

from torchrl_etl.envs import actuator_names, list_tasks

HEADER = ("name", "id (fixed goal)", "id (random goal)", "actuators", "steps")


def main() -> None:
    if sys.argv[1:] == ["names"]:
        print("\n".join(task.name for task in list_tasks()))
        return
    if sys.argv[1:]:
        sys.exit(f"Error: list_tasks.py takes 'names' or nothing, not {' '.join(sys.argv[1:])!r}.")
    rows = [
        (
            task.name,
            task.id,
            task.random_id or "-",
            str(len(actuator_names(task.name))),
            str(task.episode_steps),
        )
        for task in list_tasks()
    ]
    widths = [max(map(len, column)) for column in zip(HEADER, *rows, strict=True)]
    for row in (HEADER, ["-" * width for width in widths], *rows):
        cells = zip(row, widths, strict=True)
        # Text is left-aligned, numbers are right-aligned.
        print("  ".join(c.rjust(w) if i > 2 else c.ljust(w) for i, (c, w) in enumerate(cells)))
    print(
        "\nAny Gymnasium id with continuous actions and any DMControl domain-task work too,\n"
        "and module:id, which imports the module that registers a task of your own."
    )


if __name__ == "__main__":
    main()
