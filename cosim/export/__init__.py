"""Recordings in other formats: CSV, rosbag, video, Foxglove layout."""
