"""The names of files and folders in the folder of a run, and of a worker; and of a variable of its parent."""

from __future__ import annotations

import os

FOLDERS = ("home", "tmp", "output")
LOGS = ("stdout", "stderr")
OBSERVED = "observed.json"  # in a run's folder: what the run did with files
REPORT = os.path.join("home", ".sierra-conductor")  # the conductor's, in the run's folder
CHECKPOINT = os.path.join("home", ".sierra-checkpoint")  # in a run's folder: see `sierra.worker.checkpoints`
SHARED = "shared"  # in the folder of shared services: what their conductor tells when they are ready
TRACE = ".trace"  # the end of the name of a tracer's log, beside the run's folder
RUNS = "runs"
SLOT_LOCKS = "SIERRA_SLOT_LOCKS"  # an array task's descriptors of locks: while they are open, no other task has its slots
