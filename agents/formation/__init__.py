"""Formations over a radio: leaders, followers, consensus, and the prediction of old reports.

Start reading in `followers.leader_follower`; ``docs/explanation/formations.md`` explains the law. Methods of obstacle
avoidance do not belong here.
"""
