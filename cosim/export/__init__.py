"""Recordings in other formats: CSV, rosbag, video, Foxglove layout.

Exports read a run's folder; they neither run a scenario nor compute metrics.
"""
