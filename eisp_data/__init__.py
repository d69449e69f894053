"""Everything that makes or moves trajectories; importing it registers the Gymnasium ids."""

from eisp_data.sim.opengl import let_mujoco_do_without
from eisp_data.sim.registration import register_envs

let_mujoco_do_without()
register_envs()
