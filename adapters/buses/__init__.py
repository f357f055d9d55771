"""The wire between processes: Knowledge's hub, and the members that join it."""

from adapters.buses.hub import KnowledgeHub
from adapters.buses.member import Member
from adapters.buses.wire import Wire

__all__ = ["KnowledgeHub", "Member", "Wire"]
