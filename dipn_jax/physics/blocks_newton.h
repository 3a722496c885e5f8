// Second part of the body of the function that `blocks_kernel.py` hands to Warp: Newton's method on `blocks_cost.h`.
// Its arguments: see `solve_scene` there.

struct Newton : Terms {
    // Subtract from the rows of column j what the columns before it explain.
    CUDA_CALLABLE void reduce(int j) const
    {
        SHARE(i, SIX * j, dof) {
            const int b = i / SIX, r = SIX * (i % SIX);
            if (!has(b, j))
                continue;
            float x[SIX];
            for (int p = 0; p < SIX; ++p)
                x[p] = block(b, j)[r + p];
            WP_PRAGMA_NO_UNROLL
            for (int k = 0; k < j; ++k) {
                if (!(has(b, k) && has(j, k)))
                    continue;
                const float *mine = block(b, k) + r, *other = block(j, k);
                for (int q = 0; q < SIX; ++q) {
                    const float factor = mine[q];
                    for (int p = 0; p < SIX; ++p)
                        x[p] -= factor * other[SIX * p + q];
                }
            }
            for (int p = 0; p < SIX; ++p)
                block(b, j)[r + p] = x[p];
        }
        sync();
    }

    // Factor the Hessian and solve for Newton's step, block column by block column.
    CUDA_CALLABLE void solve() const
    {
        SHARE(i, 0, dof)
            s.step[i] = -s.gradient[i];
        for (int j = 0; j < blocks; ++j) {
            reduce(j);
            float d[SIX][SIX], z[SIX];  // every lane factors the corner, into registers; its diagonal is inverted
            WP_PRAGMA_UNROLL
            for (int p = 0; p < SIX; ++p) {
                z[p] = s.step[SIX * j + p];
                WP_PRAGMA_UNROLL
                for (int q = 0; q <= p; ++q) {
                    float x = block(j, j)[SIX * p + q];
                    WP_PRAGMA_UNROLL
                    for (int k = 0; k < q; ++k)
                        x -= d[p][k] * d[q][k];
                    d[p][q] = q < p ? x * d[q][q] : 1.0f / wp::sqrt(x);
                    z[p] = q < p ? z[p] - d[p][q] * z[q] : z[p] * d[p][p];
                }
            }
            sync();
            SHARE(i, SIX * (j + 1), dof) {
                if (!has(i / SIX, j))
                    continue;
                float *row = block(i / SIX, j) + SIX * (i % SIX), known = 0.0f, x[SIX];
                WP_PRAGMA_UNROLL
                for (int p = 0; p < SIX; ++p) {
                    x[p] = row[p];
                    WP_PRAGMA_UNROLL
                    for (int q = 0; q < p; ++q)
                        x[p] -= x[q] * d[p][q];
                    x[p] *= d[p][p];
                    row[p] = x[p];
                    known += x[p] * z[p];
                }
                s.step[i] -= known;
            }
            if (lane == 0) {
                WP_PRAGMA_UNROLL
                for (int p = 0; p < SIX; ++p) {
                    s.step[SIX * j + p] = z[p];
                    WP_PRAGMA_UNROLL
                    for (int q = 0; q <= p; ++q)
                        block(j, j)[SIX * p + q] = d[p][q];
                }
            }
            sync();
        }
        for (int j = blocks - 1; j >= 0; --j)
            substitute(j);
    }

    // Find the part of block j in the step from those of the blocks after it.
    CUDA_CALLABLE void substitute(int j) const
    {
        float z[SIX];
        WP_PRAGMA_UNROLL
        for (int p = SIX - 1; p >= 0; --p) {
            z[p] = s.step[SIX * j + p];
            WP_PRAGMA_UNROLL
            for (int q = p + 1; q < SIX; ++q)
                z[p] -= block(j, j)[SIX * q + p] * z[q];
            z[p] *= block(j, j)[(SIX + 1) * p];
        }
        sync();
        SHARE(i, 0, SIX * j)
            if (has(j, i / SIX)) {
                float known = 0.0f;
                for (int q = 0; q < SIX; ++q)
                    known += block(j, i / SIX)[SIX * q + i % SIX] * z[q];
                s.step[i] -= known;
            }
        if (lane == 0)
            for (int p = 0; p < SIX; ++p)
                s.step[SIX * j + p] = z[p];
        sync();
    }

    // First and second derivative of the cost along the step, `t` steps away: first moved, then measured.
    CUDA_CALLABLE void slopes(float t, float slope, float bend, float& first, float& second) const
    {
        float one = 0.0f, two = 0.0f;
        SHARE(r, 0, rows) {
            const float x = s.x[r] + t * s.dx[r];
            const float push = r < equalities || x < 0.0f ? s.row_weight[r] : 0.0f;
            one += push * x * s.dx[r];
            two += push * s.dx[r] * s.dx[r];
        }
        SHARE(c, 0, s.count) {
            const float* du = s.du[c];
            const float u[3] = { s.u[c][0] + t * du[0], s.u[c][1] + t * du[1], s.u[c][2] + t * du[2] };
            const Reach reach(u, s.mu[c]);
            one += s.stiffness[c] * (reach.away[0] * du[0] + reach.away[1] * du[1] + reach.away[2] * du[2]);
            two += s.stiffness[c] * reach.curvature(du);
        }
        first = slope + t * bend + sum(one);
        second = bend + sum(two);
    }

    // Return the multiple of the step with the least cost: Newton in a bracket, which is cut where he is slow.
    CUDA_CALLABLE float search(float begin, int limit) const
    {
        float slope = 0.0f, bend = 0.0f;
        SHARE(i, 0, dof) {
            slope += s.lack[i] * s.step[i];
            bend += mass_product(i, s.step) * s.step[i];
        }
        SHARE(r, 0, rows)
            s.dx[r] = row_product(r, s.step);
        SHARE(c, 0, s.count)
            for (int k = 0; k < 3; ++k)
                s.du[c][k] = product(c, k, s.step);
        slope = sum(slope);
        bend = sum(bend);
        const float flat = FLAT * wp::abs(begin);
        float low = 0.0f, high = INFINITY, t = 1.0f, best = 0.0f, steep = INFINITY, width = INFINITY;
        for (int tried = 0; tried < limit; ++tried) {
            float first, second;
            slopes(t, slope, bend, first, second);
            if (first < 0.0f)
                low = t;
            else
                high = t;
            if (wp::abs(first) < steep) {
                steep = wp::abs(first);
                best = t;
            }
            if (steep <= flat || (high < INFINITY && high - low <= NARROW * high))
                return best;
            const float guess = t - first / second;
            const float end = high < INFINITY ? high : STRETCH * low;
            const float start = low > 0.0f ? low : FIRST * high;
            const bool slow = high - low > 0.5f * width;  // never while there is no upper end
            t = guess > low && guess < end && !slow ? guess : wp::sqrt(start * end);
            width = slow ? INFINITY : high - low;
        }
        return low;  // the cost falls all the way to it
    }

    CUDA_CALLABLE void begin(const float* acceleration) const
    {
        SHARE(i, 0, dof)
            s.at[i] = acceleration[i];
    }

    // Move `s.at` to the least cost, from `start` or from `free`, where it is less; return the number of Newton's steps.
    CUDA_CALLABLE int minimize(const float* start, int iterations, int limit) const
    {
        float known = 0.0f;
        int count = 0;
        begin(free);
        for (int look = 0; count < iterations; ++look) {
            const float cost = evaluate();
            if (look == 0) {
                known = cost;
                begin(start);
                continue;
            }
            if (look == 1 && !(cost < known)) {
                begin(free);
                continue;
            }
            assemble();
            solve();
            float slope = 0.0f;
            SHARE(i, 0, dof)
                slope += s.gradient[i] * s.step[i];
            slope = sum(slope);
            const float t = slope < 0.0f ? search(slope, limit) : 0.0f;
            SHARE(i, 0, dof)
                s.at[i] += t * s.step[i];
            ++count;
            if (!(-slope / 2.0f > TOLERANCE * cost))
                break;
        }
        return count;
    }
};

#if defined(__CUDA_ARCH__)
__shared__ Memory s;
#elif WP_TILE_BLOCK_DIM > 1
static Memory s;  // of all fibers
#else
if (lane > 0)  // launched for a warp; here one lane does all the work
    return;
Memory s;
#endif

const int dof = SIX * blocks, from = scene * dof;
const Newton newton { { s, mass.data + scene * blocks * SQUARE, force.data + from, free.data + from, lane, blocks, dof,
                        rows, equalities } };
SHARE(i, 0, DOF) {
    s.at[i] = 0.0f;
    s.step[i] = i < dof ? velocity.data[from + i] : 0.0f;
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
            s.chosen[s.count++] = scene * contacts + c;
}
newton.sync();
SHARE(c, 0, s.count) {
    const int at = s.chosen[c];
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
        s.goal[c][k] = -damping.data[at] * newton.product(c, k, s.step) - (k ? 0.0f : s.mu[c] * bias.data[at]);
}
newton.sync();
newton.fill();
const int count = newton.minimize(start.data + from, iterations, limit);
SHARE(i, 0, dof)
    acceleration.data[from + i] = s.at[i];
if (lane == 0)
    steps.data[scene] = count;
#undef SHARE
