"""The command lines of tangram-train's children."""

from master.children import Child, command, override
from master.config import LaunchConfig
from master.rundir import RunFolder

PLAYER_NICE = 5
EVALUATOR_NICE = 10


def worker_child(folder: RunFolder, role: str, index: int) -> Child:
    """A worker that joins by the run's connection file, with a log of its own."""
    name = role if role == "evaluator" else f"worker {index}"
    arguments = [
        *command("worker"),
        override("connect", str(folder.connection)),
        f"index={index}",
        f"role={role}",
    ]
    nice = EVALUATOR_NICE if role == "evaluator" else PLAYER_NICE
    return Child(name, arguments, folder.logs / f"{name.replace(' ', '-')}.log", nice)


def master_arguments(config: LaunchConfig, folder: RunFolder) -> list[str]:
    """How the master is started, as arguments of this Python."""
    master = config.master
    in_step = master.service.mode == "lockstep"
    return [
        *command("master"),
        override("from_config", str(folder.config)),
        override("run_dir", str(folder.path)),
        *(
            f"{name}={getattr(master, name)}"
            for name in ("seed", "max_hours", "max_episodes", "max_updates", "resume")
        ),
        *([f"service.lockstep_workers={config.workers}"] if in_step else []),
        *([override("warm_start", master.warm_start)] if master.warm_start else []),
    ]
