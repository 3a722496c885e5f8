// Third part of a control period: the body of the function that `tick_kernel.py` hands to Warp begins; it takes a scene
// into the memory that the lanes share. Its arguments: see `advance_scene` there.

// What the lanes share; the search for contacts and the solver take turns with the same memory.
struct Memory {
    Bodies bodies;
    Problem problem;
    union {
        PairMemory pair;
        Work work;
    };
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

const int objects = blocks - 1, dof = SIX * blocks, pose = SIX + POSE * objects;
const int geoms = FIRST_PART + PARTS * objects;
const Given given {
    vertex.data + 3 * VERTICES * geoms * scene,
    face_normal.data + 3 * FACES * geoms * scene,
    radius.data + geoms * scene,
    center.data + 3 * geoms * scene,
    body_mass.data + objects * scene,
    inertia.data + 3 * objects * scene,
    friction.data + objects * scene,
    control.data + SIX * scene,
    push.data + dof * scene,
};
const Motion motion { { lane }, s.bodies, given, blocks };
const Contacts contacts { { lane }, s.bodies, s.problem, s.pair, given, blocks, most };
const Newton newton { { { lane }, s.problem, s.work, s.bodies.mass, s.bodies.force, s.bodies.free, blocks, dof, ROWS, 1 } };
motion.lay_table();
SHARE(i, 0, pose)
    s.bodies.place[i] = qpos.data[pose * scene + i];
SHARE(i, 0, DOF) {
    s.bodies.velocity[i] = i < dof ? qvel.data[dof * scene + i] : 0.0f;
    s.bodies.start[i] = i < dof ? warmstart.data[dof * scene + i] : 0.0f;
}
motion.sync();
