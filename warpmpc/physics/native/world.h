// SPDX-License-Identifier: Apache-2.0
// The state of as many worlds as a number has lanes.
struct Contact {  // lanes may hold different pairs, all of one group: the same degrees of freedom, in the same order
    T jac[ROWS * NNZ];           // normal, tangents, and rotation about these, of every degree of freedom
    T ref[ROWS];                 // reference accelerations
    T a[ROWS], s[ROWS];          // accelerations beyond the reference, and what a search direction adds to them
#if COOPERATE
    T curve[CURVE], push[PUSH];  // second and first derivatives of its cost, for all lanes of the warp
#endif
    T friction[FRICTIONS], weight;  // of the rows but the normal one, and inverse regularization; no weight where a lane is empty
#if TOLD
    T normal[3], tangent[3];
    I pair;                      // number of the lane's pair
#endif
#if SENSES_CONTACTS
    T point[3], distance;
#endif
    int group, count;
#if COOPERATE
    int raw;                     // where it was found
#endif
    unsigned used;               // lanes that hold something
};
#if COOPERATE
struct Raw {  // a contact that one lane of the warp has found
    T distance;
    V3 point, normal, tangent;
    int pair, key;               // key: by which contacts are put in order
};
#endif
#if COOPERATE
struct Frame {  // of a body that moves: columns of its rotation, and its origin
    V3 x, y, z, p;
    INNER V3 turned(V3 v) const { return x * v.x + y * v.y + z * v.z; }
    INNER V3 at(const float* v) const { return turned(vector(v)) + p; }
    INNER void turn(const float* rows) {  // on by a constant rotation
        const V3 a = turned({rows[0], rows[3], rows[6]}), b = turned({rows[1], rows[4], rows[7]});
        const V3 c = turned({rows[2], rows[5], rows[8]});
        x = a, y = b, z = c;
    }
    INNER void orient(T w, T i, T j, T k) {  // on by a quaternion of any length
        const T s = 2.0f / (w * w + i * i + j * j + k * k);
        const V3 a = turned({1.0f - s * (j * j + k * k), s * (i * j + w * k), s * (i * k - w * j)});
        const V3 b = turned({s * (i * j - w * k), 1.0f - s * (i * i + k * k), s * (j * k + w * i)});
        const V3 c = turned({s * (i * k + w * j), s * (j * k - w * i), 1.0f - s * (i * i + j * j)});
        x = a, y = b, z = c;
    }
};
struct Motion { V3 angular, linear, turning, falling; };  // velocity and acceleration without joint accelerations
struct Inertia { T xx, yy, zz, xy, xz, yz; V3 moment; T mass; };  // about the tree's point
#endif
struct World {
    const float* given;          // what scenes draw anew: numbers of the model that are no part of this source
    T q[NQ], v[NV], ctrl[NU], par[NPAR], mocap[7 * NMOCAP];
    T c[NCONTROL];               // controls of the scene
    T x[NV];                     // acceleration, and the solver's start in the next step
    T fs[NV], bias[NV], damp[NV], ma[NV], mv[NV], grad[NV], search[NV], mm[NH], h[NH];
    T ref[NV][3], cw[NV][3], cl[NV][3], gpos[NG][3], gmat[NG][9];
#if WATCHED
    T pushed[3 * WATCHED];       // forces of watched pairs
#endif
    T bpos[NB][3], bmat[NB][9], bang[NB][3], blin[NB][3];
    T lside[NLIMIT], lweight[NLIMIT], lref[NLIMIT], la[NLIMIT], ls[NLIMIT];  // limits: side, ..., as in Contact
    int ldof[NLIMIT];
#if CONSTRAINTS
    T constraint_jac[CONSTRAINTS][CONSTRAINT_DOFS], constraint_weight[CONSTRAINTS], constraint_ref[CONSTRAINTS], constraint_a[CONSTRAINTS], constraint_s[CONSTRAINTS];  // constraints.h: as in Contact
#endif
#if DRY
    T dry_weight[DRY], dry_ref[DRY], dry_a[DRY], dry_s[DRY];  // friction of joints: the same
#endif
#if TENDONS
    T tendon_length[TENDONS], tendon_speed[TENDONS], tendon_arm[TENDON_ARMS];
#if TENDON_MASSES
    T tendon_mass[TENDON_MASSES], tendon_curving[TENDONS];  // of armatures; accelerations while no joint accelerates
#endif
#endif
#if SITES
    T site_at[SITES][3], site_turn[SITES][9];  // points and frames on bodies
    T site_spin[SITES][3], site_turning[SITES][3], site_speed[SITES][3];
    T site_falling[SITES][3];    // as site_turning, acceleration while no joint accelerates
#endif
#if FLUID
    V3 fluid_force[FLUID], fluid_torque[FLUID];  // of the fluid on bodies
#if FLUID_IMPLICIT
    T fluid_push[FLUID][3], fluid_twist[FLUID][3];  // their derivatives by velocity along the axes of the boxes, over the step
#endif
#endif
#if ACTS
    T act[ACTS], act_next[ACTS];  // activations of actuators, and those after the step
#endif
#if RUNGE_KUTTA
    T begun_q[NQ], begun_v[NV], begun_x[NV], mean_v[NV], mean_a[NV];  // the step's start, and means over its stages
#if ACTS
    T begun_act[ACTS], mean_act[ACTS];
#endif
#endif
#if SKEWED
    T skew[NV], skew_up[ENTRIES], skew_down[ENTRIES];  // derivatives of bias forces by velocity: of each by its own, up and down the trees
#endif
#if SENSED
    T sensed[SENSED];            // what sensors read within a step
#if SENSES_FORCES
    T kept_x[NV];
#endif
#endif
#if SENSES_DRIVES
    T actuator_length[NU], actuator_speed[NU], actuator_force[NU], joint_force[NV];
#endif
#if SPREAD
    T spread[SPREAD];            // what an implicit step adds to the mass matrix off its diagonal
#endif
    int contacts, limits, overflow;  // overflow: lanes whose contacts were too many
    int order[CAPACITY];         // of the contacts by group, which neighbours in other lanes do not change
    Contact con[CAPACITY];
#if FEW
    I con_island[CAPACITY];      // first tree of each contact's island
#endif
#if COOPERATE
    Raw raw[CAPACITY];
    int found;
    Frame link[2][LINKS], frame[MOVING];  // of links, and of bodies that move; what lanes of links.h need of these
    Motion motion[MOVING];
    Inertia inertia[MOVING];
    V3 torque[MOVING], force[MOVING], twist[NV], shift[NV];
#endif
};
INLINE T gsize(const World& w, int g, int k) {
#if SIZES_VARY
    const int at = geom_size_at[3 * g + k];
    if (at >= 0) return w.par[at];
#endif
    return splat(w.given[GIVEN_SIZE + 3 * g + k]);
}
INLINE float bound(const World& w, int g) { return w.given[GIVEN_BOUND + g]; }
// Velocity of a body's centre of mass c, given in its frame, from its origin's
INLINE V3 centre_velocity(const World& w, int r, const T* origin, const float* c) {
    const T* m = w.bmat[r];
    const V3 arm = {m[0] * c[0] + m[1] * c[1] + m[2] * c[2], m[3] * c[0] + m[4] * c[1] + m[5] * c[2],
                    m[6] * c[0] + m[7] * c[1] + m[8] * c[2]};
    return load(origin) + cross(load(w.bang[r]), arm);
}
