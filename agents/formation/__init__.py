"""Formations over a radio: leaders, followers, consensus, and the prediction of old reports.

Start reading in `followers.leader_follower`; ``agents/README.md`` says what the law does and does not do. Methods of obstacle
avoidance do not belong here.
"""
