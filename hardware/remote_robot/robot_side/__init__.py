"""Program on the robot."""
