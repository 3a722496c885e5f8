// Third part of the search for contacts (`struct Pair` goes on): the contact of two edges.

    // Find each edge's direction, and on which side of its plane the normals of the other hull are.
    CUDA_CALLABLE void measure_edges() const
    {
        const int edges = 3 * s.hull[0].c;
        SHARE(i, 0, edges + 3 * s.hull[1].c) {
            const int which = i >= edges, e = which ? i - edges : i;
            Hull& hull = s.hull[which];
            const Hull& other = s.hull[1 - which];
            const Vector along = hull.normal[hull.left(e)].cross(hull.normal[hull.right(e)]);
            hull.direction[e] = (hull.to(e) - hull.from(e)).unit();
            for (int f = 0; f < other.c + 2; ++f)
                hull.side[e][f] = along.dot(other.normal[f]);
        }
        sync();
    }

    // Return the gap of two edges along their common normal, which goes into `axis` (unit, from the first hull); -inf,
    // and any axis, unless they can be a contact.
    CUDA_CALLABLE float edge_gap(int e, int f, const Vector& center, Vector& axis) const
    {
        const Hull &a = s.hull[0], &b = s.hull[1];
        // the arcs cross on the Gauss map; the normals of the second hull count as reversed
        const float side_b1 = -a.side[e][b.left(f)], side_b2 = -a.side[e][b.right(f)];
        if (!(side_b1 * side_b2 < 0.0f))
            return -INFINITY;
        const float side_a1 = b.side[f][a.left(e)], side_a2 = b.side[f][a.right(e)];
        if (!(side_a1 * side_a2 < 0.0f && side_b1 * side_a2 > 0.0f))
            return -INFINITY;
        axis = a.direction[e].cross(b.direction[f]);
        const float square = axis.square(), out = axis.dot(a.from(e) - center);
        if (!(square > PARALLEL))
            return -INFINITY;
        axis = axis * ((out < 0.0f ? -1.0f : 1.0f) / wp::sqrt(square));
        return axis.dot(b.from(f) - a.from(e));
    }

    // The pair of edges with the largest gap: as `_edge_contact`.
    CUDA_CALLABLE Best edge_gaps(const Vector& center) const
    {
        const int columns = 3 * s.hull[1].c;
        Best found { -INFINITY, 0 };
        SHARE(i, 0, 3 * s.hull[0].c * columns) {
            Vector axis;
            found.offer(edge_gap(i / columns, i % columns, center, axis), i);
        }
        return best(found);
    }

    // The point of an edge that is nearest to a point, and their squared distance.
    static CUDA_CALLABLE float nearest(const Vector& from, const Vector& edge, const Vector& p, Vector& out)
    {
        const float t = (p - from).dot(edge) / (edge.square() + 1e-6f);
        out = from + edge * wp::min(wp::max(t, 0.0f), 1.0f);
        return (p - out).square();
    }

    // The point halfway between two edges: as `closest_segment_to_segment_points` of MJX.
    CUDA_CALLABLE Vector halfway(int e, int f) const
    {
        const Vector from_a = s.hull[0].from(e), edge_a = s.hull[0].to(e) - from_a, a = s.hull[0].direction[e];
        const Vector from_b = s.hull[1].from(f), edge_b = s.hull[1].to(f) - from_b, b = s.hull[1].direction[f];
        const float half_a = 0.5f * wp::sqrt(edge_a.square()), half_b = 0.5f * wp::sqrt(edge_b.square());
        const Vector middle_a = from_a + a * half_a, middle_b = from_b + b * half_b, between = middle_a - middle_b;
        const float slope = a.dot(b), along_a = a.dot(between), along_b = b.dot(between);
        const float t = (slope * along_b - along_a) / (1.0f - slope * slope + 1e-6f), u = along_b + t * slope;
        const Vector on_a = middle_a + a * wp::min(wp::max(t, -half_a), half_a);
        const Vector on_b = middle_b + b * wp::min(wp::max(u, -half_b), half_b);
        Vector new_a, new_b;
        const float away_a = nearest(from_a, edge_a, on_b, new_a), away_b = nearest(from_b, edge_b, on_a, new_b);
        return (away_a < away_b ? new_a + on_b : on_a + new_b) * 0.5f;
    }
