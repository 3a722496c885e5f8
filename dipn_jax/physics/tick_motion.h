// First part of a control period, which builds on `blocks_*.h` and `narrow_*.h`: how the bodies of a scene stand and
// move without contacts. Block 0 is the hand (x, y, z, yaw and two fingers), each other block one free object, whose
// frame is at its centre of mass along its axes of inertia.
//
// Python puts in front of this text PARTS (geoms of an object) and the numbers of the model (`tick_kernel.numbers`).

enum {
    OBJECTS = BLOCKS - 1,
    FINGER_GEOMS = 4,  // link and pad of the left finger, then of the right one
    FIRST_PART = 1 + FINGER_GEOMS,  // the first geom is the floor
    GEOMS = FIRST_PART + PARTS * OBJECTS,
    POSE = 7
};

// The state of a scene, which the lanes share.
struct Bodies {
    float place[SIX + POSE * OBJECTS];  // qpos
    float velocity[DOF], start[DOF];  // qvel; acceleration that the solver begins from
    float mass[BLOCKS * SQUARE], force[DOF], free[DOF];  // of the problem
    float turn[BLOCKS + 1][9];  // rotation; the last is that of the table
    float geom[GEOMS][3];  // where geoms are: metres, world
    float light[BLOCKS + 1];  // 1 / mass
};

// What a scene is given, and does not change.
struct Given {
    const float *vertex, *face_normal, *radius, *center;  // of geoms; see `tick_kernel.kernel`
    const float *mass, *inertia, *friction, *control, *push;
};

struct Motion : Lanes {
    Bodies& b;
    const Given& given;
    const int blocks;

    CUDA_CALLABLE float* pose(int block) const { return b.place + SIX + POSE * (block - 1); }

    CUDA_CALLABLE float* row(int block, int i) const { return b.mass + SQUARE * block + SIX * i; }

    // Write what the table is: it does not move.
    CUDA_CALLABLE void lay_table() const
    {
        SHARE(i, 0, 9)
            b.turn[NONE][i] = i % 4 ? 0.0f : 1.0f;
        SHARE(i, 0, 3)
            b.geom[0][i] = 0.0f;
        if (lane == 0)
            b.light[NONE] = 0.0f;
    }

    // Find where everything is; quaternions get their unit length.
    CUDA_CALLABLE void stand() const
    {
        SHARE(k, 0, blocks) {
            float q[4] = { 1.0f, 0.0f, 0.0f, 0.0f };
            if (k == 0) {
                const Turn half(0.5f * b.place[3]);
                q[0] = half.cosine;
                q[3] = half.sine;
            } else {
                const float* p = pose(k) + 3;
                const float length = wp::sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2] + p[3] * p[3]);
                WP_PRAGMA_UNROLL
                for (int i = 0; i < 4; ++i)
                    pose(k)[3 + i] = q[i] = p[i] / length;
            }
            float* r = b.turn[k];
            r[0] = q[0] * q[0] + q[1] * q[1] - q[2] * q[2] - q[3] * q[3];
            r[1] = 2.0f * (q[1] * q[2] - q[0] * q[3]);
            r[2] = 2.0f * (q[1] * q[3] + q[0] * q[2]);
            r[3] = 2.0f * (q[1] * q[2] + q[0] * q[3]);
            r[4] = q[0] * q[0] - q[1] * q[1] + q[2] * q[2] - q[3] * q[3];
            r[5] = 2.0f * (q[2] * q[3] - q[0] * q[1]);
            r[6] = 2.0f * (q[1] * q[3] - q[0] * q[2]);
            r[7] = 2.0f * (q[2] * q[3] + q[0] * q[1]);
            r[8] = q[0] * q[0] - q[1] * q[1] - q[2] * q[2] + q[3] * q[3];
        }
        sync();
        SHARE(g, 1, FIRST_PART + PARTS * (blocks - 1)) {
            const int k = g < FIRST_PART ? 0 : 1 + (g - FIRST_PART) / PARTS;
            const float *r = b.turn[k], *from = k ? pose(k) : b.place;
            Vector at = Vector::of(given.center + 3 * g);
            if (k == 0)  // fingers open along the hand's x axis
                at.x += g <= 2 ? b.place[4] : -b.place[5];
            (Vector::of(from) + Vector { Vector::of(r).dot(at), Vector::of(r + 3).dot(at), Vector::of(r + 6).dot(at) })
                .to(b.geom[g]);
        }
    }

    // Find masses and forces of an object: gravity, what pushes it, and gyroscopic moments.
    CUDA_CALLABLE void push_object(int k) const
    {
        const float *spin = b.velocity + SIX * k + 3, *inertia = given.inertia + 3 * (k - 1);
        const float *push = given.push + SIX * k, heavy = given.mass[k - 1];
        const Vector turning = Vector::of(spin);
        const Vector moment = turning.cross({ inertia[0] * spin[0], inertia[1] * spin[1], inertia[2] * spin[2] });
        const float bias[SIX] = { 0.0f, 0.0f, heavy * -GRAVITY, moment.x, moment.y, moment.z };
        WP_PRAGMA_UNROLL
        for (int i = 0; i < SIX; ++i) {
            const float inert = i < 3 ? heavy : inertia[i - 3];
            WP_PRAGMA_UNROLL
            for (int j = 0; j < SIX; ++j)
                row(k, i)[j] = i == j ? inert : 0.0f;
            const float force = push[i] - bias[i];
            b.force[SIX * k + i] = force;
            b.free[SIX * k + i] = force / inert;
        }
        b.light[k] = 1.0f / heavy;
    }

    // Find masses and forces of the hand: its motors, and what its own turning does. Its weight is compensated.
    CUDA_CALLABLE void push_hand() const
    {
        const float c = b.turn[0][0], s = b.turn[0][3], left = b.place[4], right = b.place[5];
        const float spin = b.velocity[3], faster = 2.0f * spin, m = MASS_LEFT, n = MASS_RIGHT;
        const float far = m * left - n * right, whole = MASS_HAND + m + n;
        const float turning = INERTIA_YAW + m * left * left + n * right * right;
        const float mass[SIX][SIX] = {
            { whole, 0.0f, 0.0f, -s * far, m * c, -n * c }, { 0.0f, whole, 0.0f, c * far, m * s, -n * s },
            { 0.0f, 0.0f, whole, 0.0f, 0.0f, 0.0f },        { -s * far, c * far, 0.0f, turning, 0.0f, 0.0f },
            { m * c, m * s, 0.0f, 0.0f, m, 0.0f },          { -n * c, -n * s, 0.0f, 0.0f, 0.0f, n },
        };
        const float gain[SIX] = GAIN, damping[SIX] = DAMPING, least[SIX] = LEAST_FORCE, most[SIX] = MOST_FORCE;
        const float out = spin * spin * far;  // toward the axis
        const float aside = faster * (m * b.velocity[4] - n * b.velocity[5]);  // across it
        const float bias[SIX] = {
            -out * c - aside * s,
            -out * s + aside * c,
            0.0f,
            faster * (m * left * b.velocity[4] + n * right * b.velocity[5]),
            -m * spin * spin * left,
            -n * spin * spin * right,
        };
        WP_PRAGMA_UNROLL
        for (int i = 0; i < SIX; ++i) {
            WP_PRAGMA_UNROLL
            for (int j = 0; j < SIX; ++j)
                row(0, i)[j] = mass[i][j];
            const float pull = gain[i] * (given.control[i] - b.place[i]) - damping[i] * b.velocity[i];
            const float held = pull < least[i] ? least[i] : pull > most[i] ? most[i] : pull;  // NaN stays
            b.force[i] = held + given.push[i] - bias[i];
        }
        solve_hand(b.force, 0.0f, b.free);
        b.light[0] = FINGER_LIGHT;
    }

    // Find the acceleration of the hand from forces, its motors' damping counted as far as it acts within `time`.
    CUDA_CALLABLE void solve_hand(const float* force, float time, float* out) const
    {
        const float damping[SIX] = DAMPING;
        float d[SIX][SIX], z[SIX];  // Cholesky factor, its diagonal inverted
        WP_PRAGMA_UNROLL
        for (int p = 0; p < SIX; ++p) {
            z[p] = force[p];
            WP_PRAGMA_UNROLL
            for (int q = 0; q <= p; ++q) {
                float x = row(0, p)[q] + (p == q ? time * damping[p] : 0.0f);
                WP_PRAGMA_UNROLL
                for (int k = 0; k < q; ++k)
                    x -= d[p][k] * d[q][k];
                d[p][q] = q < p ? x * d[q][q] : 1.0f / wp::sqrt(x);
                z[p] = q < p ? z[p] - d[p][q] * z[q] : z[p] * d[p][p];
            }
        }
        WP_PRAGMA_UNROLL
        for (int p = SIX - 1; p >= 0; --p) {
            WP_PRAGMA_UNROLL
            for (int q = p + 1; q < SIX; ++q)
                z[p] -= d[q][p] * z[q];
            out[p] = z[p] *= d[p][p];
        }
    }

    // Find masses, forces and accelerations without contacts; `stand` comes first.
    CUDA_CALLABLE void push() const
    {
        SHARE(k, 0, blocks)
            if (k)
                push_object(k);
            else
                push_hand();
        sync();
    }

    // Move everything by one time step with the accelerations `a`.
    CUDA_CALLABLE void move(const float* a) const
    {
        SHARE(k, 0, blocks)
            if (k)
                move_object(k, a + SIX * k);
            else
                move_hand(a);
        sync();
    }

    CUDA_CALLABLE void move_hand(const float* a) const
    {
        float force[SIX], change[SIX];
        WP_PRAGMA_UNROLL
        for (int i = 0; i < SIX; ++i) {
            force[i] = 0.0f;
            WP_PRAGMA_UNROLL
            for (int j = 0; j < SIX; ++j)
                force[i] += row(0, i)[j] * a[j];
            b.start[i] = a[i];
        }
        solve_hand(force, STEP, change);
        WP_PRAGMA_UNROLL
        for (int i = 0; i < SIX; ++i) {
            b.velocity[i] += STEP * change[i];
            b.place[i] += STEP * b.velocity[i];
        }
    }

    CUDA_CALLABLE void move_object(int k, const float* a) const
    {
        float *v = b.velocity + SIX * k, *p = pose(k);
        WP_PRAGMA_UNROLL
        for (int i = 0; i < SIX; ++i) {
            b.start[SIX * k + i] = a[i];
            v[i] += STEP * a[i];
        }
        WP_PRAGMA_UNROLL
        for (int i = 0; i < 3; ++i)
            p[i] += STEP * v[i];
        const float speed = wp::sqrt(Vector::of(v + 3).square());
        const Turn half(0.5f * STEP * speed);
        const float share = speed > 0.0f ? half.sine / speed : 0.0f, w = half.cosine;
        const float x = share * v[3], y = share * v[4], z = share * v[5];
        const float q[4] = { p[3], p[4], p[5], p[6] };
        p[3] = q[0] * w - q[1] * x - q[2] * y - q[3] * z;
        p[4] = q[0] * x + q[1] * w + q[2] * z - q[3] * y;
        p[5] = q[0] * y - q[1] * z + q[2] * w + q[3] * x;
        p[6] = q[0] * z + q[1] * y - q[2] * x + q[3] * w;
        const float length = wp::sqrt(p[3] * p[3] + p[4] * p[4] + p[5] * p[5] + p[6] * p[6]);
        WP_PRAGMA_UNROLL
        for (int i = 3; i < POSE; ++i)
            p[i] /= length;
    }
};
