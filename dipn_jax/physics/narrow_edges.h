// Third part of the body of the function that `narrow_kernel.py` hands to Warp (`struct Shared` ends): the contact of
// two edges, and the pair itself.

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
};

// Where the contacts of a pair go.
struct Output {
    float *distance, *position, *frame;
    const int lane;

    // Write that the geoms are apart.
    CUDA_CALLABLE void apart() const
    {
        SHARE(k, 0, CONTACTS)
            distance[k] = APART;
        SHARE(k, 0, 3 * CONTACTS)
            position[k] = 0.0f;
        SHARE(k, 0, FRAME * CONTACTS)
            frame[k] = k % FRAME % 4 == 0 ? 1.0f : 0.0f;
    }

    // Write contact k; the frame is as by `make_frame` of MJX.
    CUDA_CALLABLE void write(int k, float depth, const Vector& at, const Vector& normal) const
    {
        const Vector a = normal.unit();
        const bool lies = -0.5f < a.y && a.y < 0.5f;
        const Vector up { 0.0f, lies ? 1.0f : 0.0f, lies ? 0.0f : 1.0f };
        const Vector b = (up - a * a.dot(up)).unit(), c = a.cross(b);
        const bool touches = depth < 0.0f;
        const float values[FRAME] = { a.x, a.y, a.z, b.x, b.y, b.z, c.x, c.y, c.z };
        WP_PRAGMA_UNROLL
        for (int i = 0; i < FRAME; ++i)
            frame[FRAME * k + i] = values[i];
        distance[k] = touches ? depth : APART;
        position[3 * k] = touches ? at.x : 0.0f;
        position[3 * k + 1] = touches ? at.y : 0.0f;
        position[3 * k + 2] = touches ? at.z : 0.0f;
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

const int from = pair / pairs * geoms, first = from + geom.data[2 * pair], second = from + geom.data[2 * pair + 1];
const Output output { distance.data + CONTACTS * pair, position.data + 3 * CONTACTS * pair,
                      frame.data + FRAME * CONTACTS * pair, lane };
const Shared shared { s, lane };
const Vector origin = Vector::of(place.data + 3 * second), shift = Vector::of(place.data + 3 * first) - origin;
const float *turn = rotation.data + 9 * first, *corners = vertex.data + 3 * VERTICES * second;
const float *normals = face_normal.data + 3 * FACES * second;
const bool is_plane = planes != 0;
const Vector up { turn[2], turn[5], turn[8] };  // the normal of a plane
const float reach = radius.data[second] + (is_plane ? 0.0f : radius.data[first]);
if (!(reach > 0.0f && (is_plane ? -shift.dot(up) < reach : shift.square() < reach * reach))) {
    output.apart();
    return;
}
shared.place(1, corners, normals, rotation.data + 9 * second, Vector { 0.0f, 0.0f, 0.0f });

int chosen_1 = 0, chosen_2 = 0, chosen_3 = 0, chosen_4 = 0, count = 1;
float limit = 0.0f, lift = 0.0f;  // points lower than this touch; a contact is at its point, or half its depth away
Vector normal = up;
if (is_plane) {
    count = 2 * s.hull[1].c;
    Best lowest { -INFINITY, 0 };
    SHARE(v, 0, count) {
        s.point[v] = s.hull[1].vertex[v];
        s.height[v] = (s.point[v] - shift).dot(up);
        lowest.offer(-s.height[v], v);
    }
    limit = TOUCHING - shared.best(lowest).value;
    lift = -0.5f;
} else {
    shared.place(0, vertex.data + 3 * VERTICES * first, face_normal.data + 3 * FACES * first, turn, shift);
    Best gap_a { -INFINITY, 0 }, gap_b { -INFINITY, 0 };
    shared.face_gaps(gap_a, gap_b);
    const float gap = wp::max(gap_a.value, gap_b.value);
    if (!(gap < 0.0f)) {
        output.apart();
        return;
    }
    shared.measure_edges();
    const Best edges = shared.edge_gaps(shift);
    if (edges.value > gap + PREFERENCE) {
        const int columns = 3 * s.hull[1].c, e = edges.index / columns, f = edges.index % columns;
        shared.edge_gap(e, f, shift, normal);
        if (lane == 0) {
            s.point[0] = shared.halfway(e, f);
            s.height[0] = edges.value;
        }
        shared.sync();
    } else {
        const int which = gap_a.value >= gap_b.value ? 0 : 1, face = which ? gap_b.index : gap_a.index;
        const Hull& other = s.hull[1 - which];
        const Vector reference = s.hull[which].normal[face];
        Best opposite { -INFINITY, 0 };
        SHARE(f, 0, other.c + 2)
            opposite.offer(-other.normal[f].dot(reference), f);
        count = shared.overlap(which, face, shared.best(opposite).index);
        normal = reference * (which ? -1.0f : 1.0f);
        lift = which ? -0.5f : 0.5f;
    }
}
shared.choose(count, limit, normal, chosen_1, chosen_2, chosen_3, chosen_4);
SHARE(k, 0, CONTACTS) {
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
    output.write(k, repeated ? APART : depth, at + origin, normal);
}
#undef SHARE
