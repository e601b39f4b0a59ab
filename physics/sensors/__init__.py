"""Simulated sensors and their errors. Geometry of beams and images is in `physics.raycast` and `physics.render`.

=================================  ========  ===================================================================
class                              reading   quantity
=================================  ========  ===================================================================
`positioning.Gps`                  Fix       position outdoors: slow and white errors, late
`positioning.Uwb`                  Fix       position indoors: biases near walls, geometry of anchors
`positioning.PositioningSensor`    Fix       position and heading with white errors
`motion.InertialUnit`              Imu       specific force and angular velocity in the body frame
`motion.WheelOdometry`             Odometry  pose and speeds from the turns of two wheels
`motion.Altimeter`                 Measured  ``height_m`` above the floor
`motion.Compass`                   Measured  ``yaw_rad`` from east
`motion.Magnetometer`              Measured  ``x_ut``, ``y_ut``, ``z_ut`` of the earth's field in the body frame
`detectors.Bumper`                 Measured  contact of each segment of the hull, 0 or 1
`detectors.NeighbourRange`         Measured  distance to each other vehicle within reach, m, by its name
`detectors.TargetSensor`           Looks     detections of targets in the ground cells within reach
`range_scanner.RangeScanner`       Scan      length of beams, m
`camera.Camera`                    Image     picture of what is ahead, with depths on request
=================================  ========  ===================================================================

All take the rate, phase, latency and drop-out of `physics.sensors.sensor.Sensor`. Fixes contain the standard deviation of their
noise, without biases near walls and outliers.
"""
