"""Data collection in one process, several processes, or on several machines."""

from torchrl_etl.collectors.array_transform import ArrayTransform
from torchrl_etl.collectors.batches import Batches, CollectionError
from torchrl_etl.collectors.factory import COLLECTORS, make_batches
from torchrl_etl.collectors.process import AsyncProcessWorkers, ProcessWorkers
from torchrl_etl.collectors.vector import VectorCollector
from torchrl_etl.collectors.worker_process import STOP_SIGNALS, start_resource_tracker

__all__ = [
    "COLLECTORS",
    "STOP_SIGNALS",
    "ArrayTransform",
    "AsyncProcessWorkers",
    "Batches",
    "CollectionError",
    "ProcessWorkers",
    "VectorCollector",
    "make_batches",
    "start_resource_tracker",
]
