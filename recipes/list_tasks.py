"""Print the paper's tasks: names, ids, goals, actuators and episode lengths.

python recipes/list_tasks.py
"""

from __future__ import annotations

from torchrl_etl.envs import actuator_names, list_tasks

HEADER = ("name", "id (fixed goal)", "id (random goal)", "actuators", "steps")


def main() -> None:
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
        # Words to the left, numbers to the right.
        print("  ".join(c.rjust(w) if i > 2 else c.ljust(w) for i, (c, w) in enumerate(cells)))
    print("\nAny Gymnasium id with continuous actions and any DMControl domain-task work too.")


if __name__ == "__main__":
    main()
