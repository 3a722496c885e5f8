// Last part of the body of the function that `solver_kernel.py` hands to Warp: the problem of a scene, from arrays.
// Its arguments: see `solve_scene` there.

#if defined(__CUDA_ARCH__)
__shared__ Problem s;
__shared__ Work w;
#elif WP_TILE_BLOCK_DIM > 1
static Problem s;  // of all fibers
static Work w;
#else
if (lane > 0)  // launched for a warp; here one lane does all the work
    return;
Problem s;
Work w;
#endif

const int dof = SIX * blocks, from = scene * dof;
const Newton newton { { { lane }, s, w, mass.data + scene * blocks * SQUARE, force.data + from, free.data + from, blocks,
                        dof, rows, equalities } };
SHARE(i, 0, DOF) {
    w.at[i] = 0.0f;
    w.step[i] = i < dof ? velocity.data[from + i] : 0.0f;
}
SHARE(i, 0, rows) {
    for (int q = 0; q < SIX; ++q)
        s.row[i][q] = row.data[(scene * rows + i) * SIX + q];
    s.row_goal[i] = row_goal.data[scene * rows + i];
    s.row_weight[i] = row_weight.data[scene * rows + i];
}
if (lane == 0) {
    s.count = 0;
    for (int c = 0; c < contacts; ++c)
        if (stiffness.data[scene * contacts + c] > 0.0f)
            s.side[0][s.count++] = scene * contacts + c;
}
newton.sync();
SHARE(c, 0, s.count) {
    const int at = s.side[0][c];
    // each side is 8 * block + a bit for each of the last three columns that move the body; -1: the table
    const int first = side.data[2 * at], second = side.data[2 * at + 1], swap = first > second;
    for (int k = 0; k < 3; ++k) {
        const float weight = (swap ? -1.0f : 1.0f) * scale.data[3 * at + k];
        for (int q = 0; q < 3; ++q)
            s.slide[c][3 * k + q] = weight * frame.data[9 * at + 3 * k + q];
    }
    for (int which = 0; which < 2; ++which) {
        const int body = (which == 1) == (swap == 1) ? second : first;
        const int b = body < 0 ? NONE : body / 8;
        s.side[which][c] = b;
        for (int e = 0; e < 9; ++e) {
            const float* f = s.slide[c] + e / 3 * 3;
            float value = 0.0f;
            if (body >= 0 && body >> e % 3 & 1) {
                const float* axis = axes.data + ((scene * blocks + b) * 3 + e % 3) * SIX;  // turn, then shift
                const float *p = position.data + 3 * at, *o = center.data + (scene * blocks + b) * 3;
                const float arm[3] = { p[0] - o[0], p[1] - o[1], p[2] - o[2] };
                value = axis[3] * f[0] + axis[4] * f[1] + axis[5] * f[2] + axis[0] * (arm[1] * f[2] - arm[2] * f[1])
                    + axis[1] * (arm[2] * f[0] - arm[0] * f[2]) + axis[2] * (arm[0] * f[1] - arm[1] * f[0]);
            }
            s.spin[which][c][e] = which ? -value : value;
        }
    }
    s.mu[c] = scale.data[3 * at];
    s.stiffness[c] = stiffness.data[at];
    for (int k = 0; k < 3; ++k)
        s.goal[c][k] = -damping.data[at] * newton.product(c, k, w.step) - (k ? 0.0f : s.mu[c] * bias.data[at]);
}
newton.sync();
newton.fill();
const int count = newton.minimize(start.data + from, iterations, limit);
SHARE(i, 0, dof)
    acceleration.data[from + i] = w.at[i];
if (lane == 0)
    steps.data[scene] = count;
#undef SHARE
