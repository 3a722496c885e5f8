// Last part of the body of the function that `tick_kernels.py` hands to Warp: what a state looks like to the solver, as
// dense rows.

bool full = false;
motion.stand();
motion.push();
contacts.build(newton, full);
SHARE(i, 0, SQUARE * blocks)
    mass.data[SQUARE * blocks * scene + i] = s.bodies.mass[i];
SHARE(i, 0, dof) {
    force.data[dof * scene + i] = s.bodies.force[i];
    free.data[dof * scene + i] = s.bodies.free[i];
}
SHARE(i, 0, 3 * geoms)
    place.data[3 * geoms * scene + i] = s.bodies.geom[i / 3][i % 3];
SHARE(r, 0, ROWS) {
    for (int q = 0; q < SIX; ++q)
        row.data[(ROWS * scene + r) * SIX + q] = s.problem.row[r][q];
    goal.data[ROWS * scene + r] = s.problem.row_goal[r];
    weight.data[ROWS * scene + r] = s.problem.row_weight[r];
}
for (int i = 0; i < dof; ++i) {
    SHARE(j, 0, DOF)
        s.work.at[j] = i == j ? 1.0f : 0.0f;
    motion.sync();
    SHARE(c, 0, s.problem.count)
        for (int k = 0; k < 3; ++k)
            cones.data[((most * scene + c) * 3 + k) * dof + i] = newton.product(c, k, s.work.at);
    motion.sync();
}
SHARE(c, 0, s.problem.count) {
    for (int k = 0; k < 3; ++k)
        cone_goal.data[(most * scene + c) * 3 + k] = s.problem.goal[c][k];
    stiffness.data[most * scene + c] = s.problem.stiffness[c];
    mu.data[most * scene + c] = s.problem.mu[c];
}
#undef SHARE
