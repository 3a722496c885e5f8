// Last part of a control period: its time steps.

bool full = false;
float lowest = 0.0f;
for (int step = 0; step < substeps; ++step) {
    motion.stand();
    motion.push();
    lowest = contacts.build(newton, full);
    SHARE(i, 0, DOF)
        s.work.at[i] = s.work.step[i] = 0.0f;
    motion.sync();
    newton.fill();
    newton.minimize(s.bodies.start, iterations, tries);
    motion.sync();
    motion.move(s.work.at);
}
SHARE(i, 0, pose)
    qpos_out.data[pose * scene + i] = s.bodies.place[i];
SHARE(i, 0, dof) {
    qvel_out.data[dof * scene + i] = s.bodies.velocity[i];
    warmstart_out.data[dof * scene + i] = s.bodies.start[i];
}
if (lane == 0) {
    full_out.data[scene] = full;
    depth_out.data[scene] = -lowest;
}
#undef SHARE
