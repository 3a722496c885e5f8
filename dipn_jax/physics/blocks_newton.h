// Second part of the contact solver: Newton's method on `blocks_cost.h`.

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
            w.step[i] = -w.gradient[i];
        for (int j = 0; j < blocks; ++j) {
            reduce(j);
            float d[SIX][SIX], z[SIX];  // every lane factors the corner, into registers; its diagonal is inverted
            WP_PRAGMA_UNROLL
            for (int p = 0; p < SIX; ++p) {
                z[p] = w.step[SIX * j + p];
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
                w.step[i] -= known;
            }
            if (lane == 0) {
                WP_PRAGMA_UNROLL
                for (int p = 0; p < SIX; ++p) {
                    w.step[SIX * j + p] = z[p];
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
            z[p] = w.step[SIX * j + p];
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
                w.step[i] -= known;
            }
        if (lane == 0)
            for (int p = 0; p < SIX; ++p)
                w.step[SIX * j + p] = z[p];
        sync();
    }

    // First and second derivative of the cost along the step, `t` steps away: first moved, then measured.
    CUDA_CALLABLE void slopes(float t, float slope, float bend, float& first, float& second) const
    {
        float one = 0.0f, two = 0.0f;
        SHARE(r, 0, rows) {
            const float x = w.x[r] + t * w.dx[r];
            const float push = r < equalities || x < 0.0f ? s.row_weight[r] : 0.0f;
            one += push * x * w.dx[r];
            two += push * w.dx[r] * w.dx[r];
        }
        SHARE(c, 0, s.count) {
            const float* du = w.du[c];
            const float u[3] = { w.u[c][0] + t * du[0], w.u[c][1] + t * du[1], w.u[c][2] + t * du[2] };
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
            slope += w.lack[i] * w.step[i];
            bend += mass_product(i, w.step) * w.step[i];
        }
        SHARE(r, 0, rows)
            w.dx[r] = row_product(r, w.step);
        SHARE(c, 0, s.count)
            for (int k = 0; k < 3; ++k)
                w.du[c][k] = product(c, k, w.step);
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
            w.at[i] = acceleration[i];
    }

    // Move `w.at` to the least cost, from `start` or from `free`, where it is less; return the number of Newton's steps.
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
                slope += w.gradient[i] * w.step[i];
            slope = sum(slope);
            const float t = slope < 0.0f ? search(slope, limit) : 0.0f;
            SHARE(i, 0, dof)
                w.at[i] += t * w.step[i];
            ++count;
            if (!(-slope / 2.0f > TOLERANCE * cost))
                break;
        }
        return count;
    }
};
