"""Everything that makes or moves trajectories; importing it registers the Gymnasium ids."""

from eisp_data.sim.registration import register_envs

register_envs()
