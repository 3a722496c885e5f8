// Fourth part of the search for contacts (`struct Pair` ends): a pair of geoms.

    // Find the contacts of two geoms whose bounding balls overlap; returns whether there is any.
    //
    // They go into `s.where` and `s.depth`; the axis from the first to the second into `normal`. The place of the second
    // geom counts as the origin. Of a plane, nothing but the way it stands is looked at: its normal is its z axis.
    CUDA_CALLABLE bool find(const Geom& first, const Geom& second, bool is_plane, Vector& normal) const
    {
        const Vector shift = first.shift - second.shift;
        place(1, second, Vector { 0.0f, 0.0f, 0.0f });
        int count = 0;
        float limit = 0.0f, lift = 0.0f;  // points lower than this touch; a contact is at its point, or half as deep
        if (is_plane) {
            normal = { first.turn[2], first.turn[5], first.turn[8] };
            count = 2 * s.hull[1].c;
            Best lowest { -INFINITY, 0 };
            SHARE(v, 0, count) {
                s.point[v] = s.hull[1].vertex[v];
                s.height[v] = (s.point[v] - shift).dot(normal);
                lowest.offer(-s.height[v], v);
            }
            limit = TOUCHING - best(lowest).value;
            lift = -0.5f;
        } else {
            place(0, first, shift);
            Best gap_a { -INFINITY, 0 }, gap_b { -INFINITY, 0 };
            face_gaps(gap_a, gap_b);
            const float gap = wp::max(gap_a.value, gap_b.value);
            if (!(gap < 0.0f))
                return false;
            measure_edges();
            const Best edges = edge_gaps(shift);
            if (edges.value > gap + PREFERENCE) {
                const int columns = 3 * s.hull[1].c, e = edges.index / columns, f = edges.index % columns;
                count = 1;
                edge_gap(e, f, shift, normal);
                if (lane == 0) {
                    s.point[0] = halfway(e, f);
                    s.height[0] = edges.value;
                }
                sync();
            } else {
                const int which = gap_a.value >= gap_b.value ? 0 : 1, face = which ? gap_b.index : gap_a.index;
                const Hull& other = s.hull[1 - which];
                const Vector reference = s.hull[which].normal[face];
                Best opposite { -INFINITY, 0 };
                SHARE(f, 0, other.c + 2)
                    opposite.offer(-other.normal[f].dot(reference), f);
                count = overlap(which, face, best(opposite).index);
                normal = reference * (which ? -1.0f : 1.0f);
                lift = which ? -0.5f : 0.5f;
            }
        }
        return keep(count, limit, lift, normal);
    }

    // Choose contacts among the candidates, leaving out repetitions; returns whether there is any.
    CUDA_CALLABLE bool keep(int count, float limit, float lift, const Vector& normal) const
    {
        int chosen_1 = 0, chosen_2 = 0, chosen_3 = 0, chosen_4 = 0;
        const bool any = choose(count, limit, normal, chosen_1, chosen_2, chosen_3, chosen_4);
        SHARE(k, 0, EACH) {
            float depth = APART;
            Vector at { 0.0f, 0.0f, 0.0f };
            bool repeated = false;
            for (int n = k; n >= 0; --n) {
                const int i = n == 0 ? chosen_1 : n == 1 ? chosen_2 : n == 2 ? chosen_3 : chosen_4;
                const float height = s.height[i];
                const Vector p = s.point[i] + normal * (lift * height);
                if (n == k) {
                    depth = height;
                    at = p;
                } else if (height < 0.0f && (p - at).square() < SAME * SAME)
                    repeated = true;
            }
            s.depth[k] = repeated || !(depth < 0.0f) ? APART : depth;
            s.where[k] = at;
        }
        sync();
        return any;
    }
};
