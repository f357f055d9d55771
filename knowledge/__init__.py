"""Knowledge: the records, their log, the Q-table, and what the stages share. Imports nothing of ours."""

from knowledge.free_log import FreeLog
from knowledge.log import Ack, Log, Pass
from knowledge.q_table import QTable
from knowledge.records import (
    STAGES,
    ChangePlan,
    ChangeRequest,
    Drift,
    MalformedRecord,
    Observation,
    Reading,
    Record,
    Symptom,
    from_json,
    json_schemas,
    to_json,
)
from knowledge.rows import RowLayout
from knowledge.store import Knowledge

__all__ = [
    "STAGES",
    "Ack",
    "ChangePlan",
    "ChangeRequest",
    "Drift",
    "FreeLog",
    "Knowledge",
    "Log",
    "MalformedRecord",
    "Observation",
    "Pass",
    "QTable",
    "Reading",
    "Record",
    "RowLayout",
    "Symptom",
    "from_json",
    "json_schemas",
    "to_json",
]
