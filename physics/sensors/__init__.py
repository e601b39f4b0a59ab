"""Simulated sensors and their errors, one sensor a file. Geometry of beams and images is in `physics.raycast` and `render`.

=================================  ========  ===================================================================
class                              reading   quantity
=================================  ========  ===================================================================
`gps.Gps`                          Fix       position outdoors: slow and white errors, late
`uwb.Uwb`                          Fix       position indoors: biases near walls, geometry of anchors
`positioning.PositioningSensor`    Fix       position and heading with white errors
`imu.InertialUnit`                 Imu       specific force and angular velocity in the body frame
`wheel_odometry.WheelOdometry`     Odometry  pose and speeds from the turns of two wheels
`bumper.Bumper`                    Measured  contact of each segment of the hull, 0 or 1
`neighbour_range.NeighbourRange`   Measured  distance to each other vehicle within reach, m, by its name
`altimeter.Altimeter`              Measured  ``height_m`` above the floor
`compass.Compass`                  Measured  ``yaw_rad`` from east
`target_detector.TargetSensor`     Looks     detections of targets in the ground cells within reach
=================================  ========  ===================================================================

All take the rate, phase, latency and drop-out of `physics.sensors.sensor.Sensor`. Fixes contain the standard deviation of their
noise, without biases near walls and outliers.
"""
