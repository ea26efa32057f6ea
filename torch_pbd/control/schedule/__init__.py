"""Schedules of motion and gains: rows, checks and files, which need only NumPy."""

from torch_pbd.control.schedule.schedule import Schedule

__all__ = ["Schedule"]
