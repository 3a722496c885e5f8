"""Push or grasp? Decide on one of the ten hard tables with the networks that come with the package."""

import jax

import dipn_jax

names, scenes, poses = dipn_jax.load_cases()
observation = dipn_jax.render(scenes[0], poses[0])
policy = dipn_jax.load_policy("dipn+gn")
decision = policy(jax.random.key(0), observation)
print("push" if decision.is_push else "grasp", decision.push if decision.is_push else decision.grasp)
