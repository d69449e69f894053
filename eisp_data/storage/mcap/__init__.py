"""MCAP, the raw log of a robot: writing, reading, repairing, checking and converting it.

``writer.McapWriter`` records, ``reader.McapLog`` reads whatever is left of a file,
``repair.repair`` makes a whole file of it, ``check.checks`` says what is wrong with it, and
``convert.convert`` turns recordings (ROS 2 bags included) into a LeRobot dataset.
"""
