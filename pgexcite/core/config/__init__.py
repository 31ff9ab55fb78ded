"""Scenarios: TOML files, validated as a whole, turned into a system, its events and its controllers."""

from pgexcite.core.config.files import merge, read
from pgexcite.core.config.remarks import remarks
from pgexcite.core.config.scenario import Scenario, from_data, load
from pgexcite.core.config.schema import json_schema

__all__ = ["Scenario", "from_data", "json_schema", "load", "merge", "read", "remarks"]
