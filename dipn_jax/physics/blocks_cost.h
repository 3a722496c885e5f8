// First part of the contact solver, which builds on `lanes.h`: what the acceleration of a scene costs, with gradient and
// Hessian; the second part is `blocks_newton.h`.
//
// The cost is that of `cone.py`. A contact moves two blocks of six degrees of freedom at most, so the Hessian and its
// Cholesky factor are blocks of 6 x 6, and only those are computed that a contact, or elimination, fills. Every sum is
// taken in a fixed order: no atomics.
//
// Python puts in front of this text: BLOCKS, CONTACTS, ROWS (capacities), and TOLERANCE, FLAT, NARROW, FIRST, STRETCH
// and TINY (see `cone.py`).

enum { SIX = 6, SQUARE = 36, NONE = BLOCKS, DOF = SIX * (BLOCKS + 1) };

// The problem, which the lanes share.
struct Problem {
    float row[ROWS][SIX], row_goal[ROWS], row_weight[ROWS];
    float slide[CONTACTS][9], spin[2][CONTACTS][9];  // Jacobians [3, 3] of a contact: x, y, z, and the other three
    float goal[CONTACTS][3], stiffness[CONTACTS], mu[CONTACTS];
    int side[2][CONTACTS];  // block with the higher number, and the other or NONE
    int filled[BLOCKS], count;  // bits of the blocks in a row of the factor; contacts that touch
};

// What the lanes share while they solve it. The last block of vectors is always zero: it is what a contact with the
// table moves.
struct Work {
    float hessian[BLOCKS * (BLOCKS + 1) / 2 * SQUARE];  // blocks of the lower triangle, by rows; later the factor
    float at[DOF], lack[DOF], gradient[DOF], step[DOF];  // acceleration; mass * at - force; of the cost; Newton's
    float x[ROWS], dx[ROWS], pushing[ROWS];  // residual, its change along the step, weight if the row pushes
    float u[CONTACTS][3], du[CONTACTS][3];
    float away[CONTACTS][3], bent[CONTACTS][6];  // gradient and Hessian of what a contact pays
    float jacobian[2][3][2 * SIX], weighted[2][3][2 * SIX];  // of one contact, and of the next
    float scratch[LANES];
};

// The place of a residual with respect to its cone, as `cone._Reach`.
struct Reach {
    float away[3], beside, inward[3], tangent[3], bend;
    bool below;

    CUDA_CALLABLE Reach(const float* u, float mu)
    {
        const float length = wp::sqrt(u[1] * u[1] + u[2] * u[2]);
        const float divisor = length > TINY ? length : TINY;
        const float gap = u[0] - mu * length, lack = gap < 0.0f ? gap : 0.0f;
        below = mu * u[0] + length <= 0.0f && u[0] < 0.0f;
        beside = below || lack >= 0.0f ? 0.0f : 1.0f / (1.0f + mu * mu);
        bend = -lack * mu / divisor;
        for (int k = 0; k < 3; ++k) {
            tangent[k] = k ? u[k] / divisor : 0.0f;
            inward[k] = k ? -mu * tangent[k] : 1.0f;
            away[k] = below ? u[k] : beside * lack * inward[k];
        }
    }

    // Second derivative of half the squared distance along `v`.
    CUDA_CALLABLE float curvature(const float* v) const
    {
        const float along = tangent[1] * v[1] + tangent[2] * v[2];
        const float p = v[1] - along * tangent[1], q = v[2] - along * tangent[2];
        const float in = v[0] + inward[1] * v[1] + inward[2] * v[2];
        const float side = in * in + bend * (p * p + q * q);
        return below ? v[0] * v[0] + v[1] * v[1] + v[2] * v[2] : beside * side;
    }

    // Second derivative of half the squared distance, entry (k, l).
    CUDA_CALLABLE float entry(int k, int l) const
    {
        const float unit = k == l ? 1.0f : 0.0f;
        const float across = k && l ? unit - tangent[k] * tangent[l] : 0.0f;
        return below ? unit : beside * (inward[k] * inward[l] + bend * across);
    }
};

struct Terms : Lanes {
    Problem& s;
    Work& w;
    const float *mass, *force, *free;
    const int blocks, dof, rows, equalities;

    // Sum of what all lanes bring; the same bits in every lane.
    CUDA_CALLABLE float sum(float mine) const
    {
#if defined(__CUDA_ARCH__)
        for (int far = LANES / 2; far > 0; far /= 2)
            mine += __shfl_xor_sync(0xffffffffu, mine, far);
        return mine;
#else
        if (LANES == 1)
            return mine;
        w.scratch[lane] = mine;
        sync();
        float all = 0.0f;
        for (int i = 0; i < LANES; ++i)
            all += w.scratch[i];
        sync();
        return all;
#endif
    }

    CUDA_CALLABLE float* block(int i, int j) const { return w.hessian + (i * (i + 1) / 2 + j) * SQUARE; }

    CUDA_CALLABLE bool has(int i, int j) const { return s.filled[i] >> j & 1; }

    // Row k of the Jacobian of contact c, times a vector.
    CUDA_CALLABLE float product(int c, int k, const float* vector) const
    {
        const float *high = vector + SIX * s.side[0][c], *low = vector + SIX * s.side[1][c];
        float out = 0.0f;
        for (int q = 0; q < 3; ++q)
            out += s.slide[c][3 * k + q] * (high[q] - low[q]) + s.spin[0][c][3 * k + q] * high[3 + q]
                + s.spin[1][c][3 * k + q] * low[3 + q];
        return out;
    }

    CUDA_CALLABLE float row_product(int r, const float* vector) const
    {
        float out = 0.0f;
        for (int q = 0; q < SIX; ++q)
            out += s.row[r][q] * vector[q];
        return out;
    }

    CUDA_CALLABLE float mass_product(int i, const float* vector) const
    {
        float out = 0.0f;
        for (int q = 0; q < SIX; ++q)
            out += mass[SIX * i + q] * vector[i / SIX * SIX + q];
        return out;
    }

    // Find which blocks of the factor are not zero.
    CUDA_CALLABLE void fill() const
    {
        if (lane == 0) {
            for (int i = 0; i < blocks; ++i)
                s.filled[i] = 1 << i;
            for (int c = 0; c < s.count; ++c)
                if (s.side[1][c] != NONE)
                    s.filled[s.side[0][c]] |= 1 << s.side[1][c];
            for (int k = 0; k < blocks; ++k)
                for (int j = k + 1; j < blocks; ++j)
                    for (int i = j + 1; has(j, k) && i < blocks; ++i)
                        if (has(i, k))
                            s.filled[i] |= 1 << j;
        }
    }

    // Compute at `w.at` what every contact and row pays, and its derivatives; return the cost.
    CUDA_CALLABLE float evaluate() const
    {
        sync();
        float cost = 0.0f;
        SHARE(i, 0, dof) {
            w.lack[i] = mass_product(i, w.at) - force[i];
            cost += w.lack[i] * (w.at[i] - free[i]);
        }
        SHARE(r, 0, rows) {
            w.x[r] = row_product(r, w.at) - s.row_goal[r];
            w.pushing[r] = r < equalities || w.x[r] < 0.0f ? s.row_weight[r] : 0.0f;
            cost += w.pushing[r] * w.x[r] * w.x[r];
        }
        SHARE(c, 0, s.count) {
            for (int k = 0; k < 3; ++k)
                w.u[c][k] = product(c, k, w.at) - s.goal[c][k];
            const Reach reach(w.u[c], s.mu[c]);
            const float stiff = s.stiffness[c];
            for (int k = 0; k < 3; ++k) {
                w.away[c][k] = stiff * reach.away[k];
                cost += w.away[c][k] * reach.away[k];
                for (int l = 0; l <= k; ++l)
                    w.bent[c][k * (k + 1) / 2 + l] = stiff * reach.entry(k, l);
            }
        }
        cost = sum(cost) / 2.0f;
        sync();  // a shuffle does not wait for shared memory
        return cost;
    }

    // Put gradient and Hessian together, contact by contact, so that no two lanes add to the same number.
    CUDA_CALLABLE void assemble() const
    {
        SHARE(i, 0, dof) {
            const int b = i / SIX;
            WP_PRAGMA_NO_UNROLL
            for (int j = 0; j <= b; ++j)
                if (has(b, j))
                    for (int q = 0; q < SIX; ++q)
                        block(b, j)[i % SIX * SIX + q] = j == b ? mass[SIX * i + q] : 0.0f;
            w.gradient[i] = w.lack[i];
            for (int r = 0; i < SIX && r < rows; ++r) {
                const float part = w.pushing[r] * s.row[r][i];
                w.gradient[i] += part * w.x[r];
                for (int q = 0; q < SIX; ++q)
                    w.hessian[SIX * i + q] += part * s.row[r][q];
            }
        }
        sync();
        int buffer = 0;
        for (int c = 0; c < s.count; ++c) {
            const float* b = w.bent[c];
            if (b[0] == 0.0f)  // it does not push
                continue;
            const int high = s.side[0][c], low = s.side[1][c], columns = low == NONE ? SIX : 2 * SIX;
            SHARE(col, 0, columns) {
                const int which = col / SIX, q = col % SIX;
                float j[3], pull = 0.0f;
                for (int k = 0; k < 3; ++k) {
                    j[k] = q < 3 ? (which ? -1.0f : 1.0f) * s.slide[c][3 * k + q] : s.spin[which][c][3 * k + q - 3];
                    w.jacobian[buffer][k][col] = j[k];
                    pull += w.away[c][k] * j[k];
                }
                w.weighted[buffer][0][col] = b[0] * j[0] + b[1] * j[1] + b[3] * j[2];
                w.weighted[buffer][1][col] = b[1] * j[0] + b[2] * j[1] + b[4] * j[2];
                w.weighted[buffer][2][col] = b[3] * j[0] + b[4] * j[1] + b[5] * j[2];
                w.gradient[SIX * s.side[which][c] + q] += pull;
            }
            sync();
            SHARE(task, 0, low == NONE ? SIX : 3 * SIX) {
                const int part = task / SIX, r = task % SIX;  // blocks (high, high), (high, low), (low, low)
                const int from = part == 2 ? SIX : 0, to = part ? SIX : 0;
                float* target = block(part == 2 ? low : high, part ? low : high) + SIX * r;
                for (int k = 0; k < 3; ++k) {
                    const float x = w.jacobian[buffer][k][from + r];
                    for (int q = 0; q < SIX; ++q)
                        target[q] += x * w.weighted[buffer][k][to + q];
                }
            }
            buffer = 1 - buffer;  // the next contact's is written while this one's is still read
        }
        sync();
    }
};
