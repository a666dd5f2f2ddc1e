"""A task of your own: raise the tool. Goal, reward and success are Warp kernels, part of the captured step.

python train.py plugins=[examples.add_a_task] env.task=raise_tool
python train.py plugins=[examples.add_a_task] hydra.searchpath=[file://examples/conf] env=raise_tool

The second may also change the preset's options: env.task_options.height=0.8.
"""

import warp as wp

from franka_wm.envs.tasks import Task, register

HEIGHT = 0.75
"""Where the tool shall be, unless ``env.task_options.height`` says otherwise [m]."""


@wp.kernel
def place_goal(mask: wp.array[wp.bool], height: float, goal: wp.array2d[float]):
    world = wp.tid()
    if mask[world]:
        goal[world, 0] = 0.3
        goal[world, 1] = 0.0
        goal[world, 2] = height


@wp.kernel
def height_reward(
    state: wp.array2d[float], height: float, reward: wp.array2d[float], success: wp.array2d[wp.bool]
):
    world = wp.tid()
    missing = wp.max(height - state[world, 16], 0.0)  # 16: the tool's z
    reward[world, 0] = -missing
    success[world, 0] = missing == 0.0


class RaiseTool(Task):
    """The reward is minus what is missing to the height [m]; a success is to be above it.

    That, the return and the height at the end are what tables and curves of a run show.
    """

    option_defaults = {"height": HEIGHT}

    def reset(self, sim, mask):
        wp.launch(
            place_goal, sim.num_envs, [mask, self.options["height"], sim.warp.task_goal], device=sim.device
        )

    def reward_and_success(self, sim):
        w = sim.warp
        inputs = [w.next_true_state, self.options["height"], w.reward, w.success]
        wp.launch(height_reward, sim.num_envs, inputs, device=sim.device)

    def measures(self, sim):
        return {"height [m]": sim.tensors.next_true_state[:, 16]}


register("raise_tool", RaiseTool)
