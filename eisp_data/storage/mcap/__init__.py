"""MCAP, the raw log of a robot: writing, reading, repairing, checking and converting it.

``writer.McapWriter`` records, ``reader.McapLog`` reads whatever is left of a file,
``repair.repair`` makes a whole file of it, ``check.checks`` says what is wrong with it, and
``convert.convert`` turns recordings (ROS 2 bags included) into a LeRobot dataset. A session::

    with McapWriter("run.mcap", metadata={"task": "stack", "instruction": "Stack."}) as log:
        log.event("episode_start", policy="eisp", operator="ann")
        log.vector("/goal", goal, role="observation.desired_goal")
        while running:
            log.image("/camera/top/image", rgb, taken_ns)
            log.log("/joint_states", messages.joints(names, angles, read_ns), read_ns)
            log.vector("/achieved", reached, read_ns, role="observation.achieved_goal")
            log.vector("/command", sent, sent_ns, role="action")
        log.event("episode_end", outcome="success")
"""
