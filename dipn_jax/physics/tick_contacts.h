// Second part of a control period: the contacts of a scene, and the hand's own constraints, as the solver takes them.

// A rule of MuJoCo: how strongly and how stiffly a constraint is pulled back, by how far it is violated.
struct Rule {
    float stiffness, damping, least, most, width, middle, power;

    // Share of the violation that is undone: as `_kbi` of MJX.
    CUDA_CALLABLE float impedance(float distance) const
    {
        const float x = wp::abs(distance) / width;
        const float lower = raised(x) / raised(middle) * middle;
        const float upper = 1.0f - raised(1.0f - x) / raised(1.0f - middle) * (1.0f - middle);
        const float share = least + (x < middle ? lower : upper) * (most - least);
        return x > 1.0f ? most : wp::min(wp::max(share, least), most);
    }

    CUDA_CALLABLE float raised(float x) const { return power == 2.0f ? x * x : wp::pow(x, power); }

    // What keeps a constraint from being met at once, where bodies of that inverse mass are held.
    CUDA_CALLABLE float resistance(float light, float distance) const
    {
        const float share = impedance(distance);
        return wp::max(light * (1.0f - share) / share, LEAST_RESISTANCE);
    }
};

struct Contacts : Lanes {
    Bodies& b;
    Problem& s;
    PairMemory& pair;
    const Given& given;
    const int blocks, most;

    // Return the number of the block that a geom is of; of the floor, NONE.
    static CUDA_CALLABLE int block_of(int geom)
    {
        return geom == 0 ? NONE : geom < FIRST_PART ? 0 : 1 + (geom - FIRST_PART) / PARTS;
    }

    // Return which lanes bring true, as bits.
    CUDA_CALLABLE unsigned vote(bool mine) const
    {
#if defined(__CUDA_ARCH__)
        return __ballot_sync(0xffffffffu, mine);
#else
        if (LANES == 1)
            return mine;
        pair.index[lane] = mine;
        sync();
        unsigned all = 0u;
        for (int i = 0; i < LANES; ++i)
            all |= unsigned(pair.index[i]) << i;
        sync();
        return all;
#endif
    }

    CUDA_CALLABLE Geom geom(int g) const
    {
        return { given.vertex + 3 * VERTICES * g, given.face_normal + 3 * FACES * g, b.turn[block_of(g)],
                 Vector::of(b.geom[g]) };
    }

    // Return whether the bounding balls of two geoms overlap, or a ball and the floor (the geom 0).
    CUDA_CALLABLE bool near(int first, int second) const
    {
        const Vector at = Vector::of(b.geom[second]);
        const float reach = given.radius[first] + given.radius[second];
        if (!(given.radius[second] > 0.0f))
            return false;
        return first ? (at - Vector::of(b.geom[first])).square() < reach * reach : at.z < reach;
    }

    // Find all contacts; returns the lowest distance. Of more than there is room for, the first are kept.
    //
    // Each is written as it is found: axis into `slide`, place into `goal`, distance into `stiffness`, geoms into `side`.
    CUDA_CALLABLE float search(int& count) const
    {
        const Pair narrow { { lane }, pair };
        const int geoms = FIRST_PART + PARTS * (blocks - 1);
        float lowest = 0.0f;
        count = 0;
        for (int first = 0; first < geoms; ++first) {
            if (first && !(given.radius[first] > 0.0f))
                continue;
            for (int from = first < FIRST_PART ? FIRST_PART : FIRST_PART + PARTS * block_of(first); from < geoms;
                 from += LANES) {
                unsigned left = vote(from + lane < geoms && near(first, from + lane));
                for (int second = from; left; left >>= 1, ++second) {
                    Vector normal;
                    if (left & 1u && narrow.find(geom(first), geom(second), first == 0, normal))
                        take(first, second, normal.unit(), lowest, count);
                }
            }
        }
        return lowest;
    }

    // Find all that holds the bodies, as the solver takes it; returns the lowest distance. `full` becomes true where there
    // are as many contacts as there is room for.
    CUDA_CALLABLE float build(const Terms& terms, bool& full) const
    {
        int count;
        const float lowest = search(count);
        full = full || count >= most;
        if (lane == 0)
            s.count = wp::min(count, most);
        SHARE(r, 0, ROWS)
            bind(r);
        sync();
        SHARE(c, 0, s.count)
            prepare(c, terms);
        sync();
        return lowest;
    }

    // Write the contacts of a pair, if there is room.
    CUDA_CALLABLE void take(int first, int second, const Vector& normal, float& lowest, int& count) const
    {
        for (int k = 0; k < EACH; ++k) {
            const float depth = pair.depth[k];
            if (!(depth < 0.0f))
                continue;
            lowest = wp::min(lowest, depth);
            if (count < most && lane == k % LANES) {
                normal.to(s.slide[count]);
                (pair.where[k] + Vector::of(b.geom[second])).to(s.goal[count]);
                s.stiffness[count] = depth;
                s.side[0][count] = second;
                s.side[1][count] = first;
            }
            ++count;
        }
    }

    // Turn what `search` wrote about contact c into what the solver takes.
    CUDA_CALLABLE void prepare(int c, const Terms& terms) const
    {
        const Rule rule = CONTACT_RULE;
        const Vector at = Vector::of(s.goal[c]);
        const int first = s.side[1][c], high = block_of(s.side[0][c]), low = block_of(first);
        const float distance = s.stiffness[c], grip = friction(first, high);
        const float mu = grip / ROOT_IMPRATIO, light = b.light[high] + b.light[low];
        s.side[0][c] = high;
        s.side[1][c] = low;
        s.mu[c] = mu;
        s.stiffness[c] = 1.0f / (rule.resistance(light, distance) * wp::max(mu * mu, TINY));
        float* slide = s.slide[c];
        Vector::of(slide).frame(slide);
        WP_PRAGMA_UNROLL
        for (int e = 0; e < 9; ++e)
            slide[e] *= e < 3 ? mu : grip;
        const Vector arm = at - Vector::of(b.place + SIX + POSE * (high - 1));
        const Vector other = at - Vector::of(low && low != NONE ? b.place + SIX + POSE * (low - 1) : b.place);
        const float *turn = b.turn[high], *hold = b.turn[low];
        WP_PRAGMA_UNROLL
        for (int k = 0; k < 3; ++k) {
            const Vector f = Vector::of(slide + 3 * k), moment = arm.cross(f), back = other.cross(f) * -1.0f;
            WP_PRAGMA_UNROLL
            for (int q = 0; q < 3; ++q)
                s.spin[0][c][3 * k + q] = turn[q] * moment.x + turn[3 + q] * moment.y + turn[6 + q] * moment.z;
            if (low == NONE)
                Vector { 0.0f, 0.0f, 0.0f }.to(s.spin[1][c] + 3 * k);
            else if (low)
                WP_PRAGMA_UNROLL
                for (int q = 0; q < 3; ++q)
                    s.spin[1][c][3 * k + q] = hold[q] * back.x + hold[3 + q] * back.y + hold[6 + q] * back.z;
            else {
                const float along = -hold[0] * f.x - hold[3] * f.y;  // minus f along the hand's x axis
                Vector { back.z, first <= 2 ? along : 0.0f, first <= 2 ? 0.0f : -along }.to(s.spin[1][c] + 3 * k);
            }
        }
        const float bias = rule.stiffness * rule.impedance(distance) * distance;
        WP_PRAGMA_UNROLL
        for (int k = 0; k < 3; ++k)
            s.goal[c][k] = -rule.damping * terms.product(c, k, b.velocity) - (k ? 0.0f : mu * bias);
    }

    // Friction of a geom with an object: of the floor, of a finger, or of a part of another object.
    CUDA_CALLABLE float friction(int first, int block) const
    {
        const float own = given.friction[block - 1];
        if (first == 0)
            return own;
        if (first < FIRST_PART)
            return first % 2 ? LINK_FRICTION : PAD_FRICTION;
        return OBJECT_RATIO * wp::max(own, given.friction[block_of(first) - 1]);
    }

    // Write the hand's constraints: both fingers open equally wide, and each stays between its stops.
    CUDA_CALLABLE void bind(int r) const
    {
        const Rule equality = EQUAL_RULE, stop = STOP_RULE, rule = r ? stop : equality;
        const float low = b.place[3 + r] - LEAST_OPEN, high = MOST_OPEN - b.place[3 + r];  // of finger r
        const float distance = r ? wp::min(low, high) : b.place[4] - b.place[5];
        const float sign = r == 0 ? 1.0f : distance < 0.0f ? (low < high ? 1.0f : -1.0f) : 0.0f;
        float rate = 0.0f;
        WP_PRAGMA_UNROLL
        for (int q = 0; q < SIX; ++q) {
            const float entry = r == 0 ? (q == 4 ? 1.0f : q == 5 ? -1.0f : 0.0f) : q == 3 + r ? sign : 0.0f;
            s.row[r][q] = entry;
            rate += entry * b.velocity[q];
        }
        const float pull = r && sign == 0.0f ? 0.0f : rule.stiffness * rule.impedance(distance) * distance;
        s.row_goal[r] = -rule.damping * rate - pull;
        s.row_weight[r] = 1.0f / rule.resistance(r ? STOP_LIGHT : EQUAL_LIGHT, distance);
    }
};
