"""The processes of a run by their names.

A role is the component that sends a stage's records: execute (Observation), monitor (Symptom), analyze (ChangeRequest),
plan (ChangePlan).
"""

KNOWLEDGE = "knowledge"
"""The process that all others connect to."""

ROLES = ("execute", "monitor", "analyze", "plan")
"""The roles, in the order of their stages."""

OPERATOR = "operator"
"""A person who looks at a run, or changes a part of it."""

STAGE_OF: dict[str, int] = {role: stage for stage, role in enumerate(ROLES)}
"""Role -> number of the stage whose records it sends."""
