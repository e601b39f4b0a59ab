"""Bodies in MuJoCo, the entry is `engine`. Only here is MuJoCo imported. No motion without MuJoCo belongs here."""
