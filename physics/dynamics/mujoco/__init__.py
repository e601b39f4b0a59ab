"""Bodies in MuJoCo; start reading in `engine`. No other package imports MuJoCo, and no motion without MuJoCo belongs here."""
