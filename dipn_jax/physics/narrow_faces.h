// Second part of the search for contacts (`struct Pair` goes on): up to four contacts of one face with another, chosen
// as by `_create_contact_manifold` and `_manifold_points` of MJX.

    // Clip an edge by the planes through the edges of a face; returns whether anything of it is inside.
    CUDA_CALLABLE bool clip(const Hull& hull, int face, Vector& p, Vector& q) const
    {
        const Vector a = p, b = q, edge = b - a, normal = hull.normal[face];
        float most_p = 0.0f, most_q = 0.0f;
        bool inside = true;
        const int size = hull.size(face);
        for (int k = 0; k < size; ++k) {
            const Vector corner = hull.corner(face, k ? k - 1 : size - 1);
            const Vector out = (hull.corner(face, k) - corner).cross(normal);
            const float height_p = (a - corner).dot(out), height_q = (b - corner).dot(out);
            const bool front_p = height_p > CLIP_SLACK, front_q = height_q > CLIP_SLACK;
            inside = inside && !(front_p && front_q);
            const float rise = out.dot(edge);
            const float t = wp::min(wp::max(-height_p / (rise == 0.0f ? CLIP_SLACK : rise), 0.0f), 1.0f);
            const Vector cut = a + edge * t;
            const float far_p = (cut - a).dot(edge), far_q = (b - cut).dot(edge);
            if (front_p && far_p > most_p) {
                most_p = far_p;
                p = cut;
            }
            if (front_q && far_q > most_q) {
                most_q = far_q;
                q = cut;
            }
        }
        return inside && !(edge.dot(q - p) < 0.0f);
    }

    // Find the points where a reference face and an incident one overlap; returns their number.
    CUDA_CALLABLE int overlap(int which, int face, int incident) const
    {
        const Hull &ours = s.hull[which], &other = s.hull[1 - which];
        const Vector normal = ours.normal[face], tilted = other.normal[incident];
        const Vector base = ours.corner(face, 0), seen = other.corner(incident, 0);
        const int theirs = other.size(incident), count = theirs + ours.size(face);
        const float slope = normal.dot(tilted), divisor = slope == 0.0f ? CLIP_SLACK : slope;
        SHARE(i, 0, count) {
            const bool mine = i >= theirs;  // an edge of the reference face, seen on the incident one
            const Hull& hull = mine ? ours : other;
            const int f = mine ? face : incident, k = mine ? i - theirs : i;
            Vector p = hull.corner(f, k ? k - 1 : hull.size(f) - 1), q = hull.corner(f, k);
            if (mine) {
                p = p + normal * ((seen - p).dot(tilted) / divisor);
                q = q + normal * ((seen - q).dot(tilted) / divisor);
            }
            const bool inside = clip(mine ? other : ours, mine ? incident : face, p, q);
            const float height_p = (p - base).dot(normal), height_q = (q - base).dot(normal);
            s.point[2 * i] = p - normal * height_p;
            s.point[2 * i + 1] = q - normal * height_q;
            s.height[2 * i] = inside && height_p < -CLIP_SLACK ? height_p : APART;
            s.height[2 * i + 1] = inside && height_q < -CLIP_SLACK ? height_q : APART;
        }
        sync();  // `best` does not wait for shared memory on a GPU
        return 2 * count;
    }

    // Choose four of the points lower than `limit` that span a large area; returns whether there is any.
    CUDA_CALLABLE bool choose(int count, float limit, const Vector& normal, int& i, int& j, int& k, int& l) const
    {
        const Best none { -INFINITY, 0 };
        Best found = none;
        SHARE(p, 0, count)
            found.offer(s.height[p] < limit ? 0.0f : -INFINITY, p);
        found = best(found);
        if (found.value < 0.0f)
            return false;
        const Vector a = s.point[i = found.index];
        found = none;
        SHARE(p, 0, count)
            found.offer(s.height[p] < limit ? (a - s.point[p]).square() : -INFINITY, p);  // farthest from the first
        const Vector b = s.point[j = best(found).index], ab = normal.cross(a - b);
        found = none;
        SHARE(p, 0, count)
            found.offer(s.height[p] < limit ? wp::abs(ab.dot(a - s.point[p])) : -INFINITY, p);  // from their line
        const Vector c = s.point[k = best(found).index], ac = normal.cross(a - c), bc = normal.cross(b - c);
        found = none;
        SHARE(p, 0, count) {
            const float beside = wp::abs(bc.dot(b - s.point[p])) + wp::abs(ac.dot(a - s.point[p]));
            found.offer(s.height[p] < limit ? beside : -INFINITY, p);  // from the other two sides
        }
        l = best(found).index;
        return true;
    }
