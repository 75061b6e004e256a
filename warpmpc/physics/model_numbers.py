# SPDX-License-Identifier: Apache-2.0
"""Numbers of MuJoCo models: which model it is, and what differs between models of one structure.

Every field of ``MjModel``, ``MjOption`` (``opt.``) and ``MjStatistic`` (``stat.``), and what rollouts make of it.

Caches and comparisons of models look at all fields but those that say nothing (:func:`says_something`). A field that a
newer MuJoCo adds is looked at, too, and fails a test until it is in this table.
"""

from __future__ import annotations

import ctypes
import hashlib
import operator
import weakref
from collections.abc import Iterator, Sequence
from types import SimpleNamespace

import mujoco
import numpy as np


def _names(text: str) -> frozenset[str]:
    """Names of lines ``prefix: end end ...``, which may go on indented; the prefix ``-`` is none."""
    out, prefix = set(), ""
    for line in text.strip().splitlines():
        if not line.startswith(" "):
            prefix, _, line = line.partition(":")
        out |= {prefix.removeprefix("-") + end for end in line.split()}
    return frozenset(out)


READ = _names("""
-: qpos0
actuator_: acc0 actearly actlimited actrange armature biasprm cranklength ctrllimited ctrlrange damping dampingpoly
    dynprm forcelimited forcerange gainprm gear group lengthrange
body_: gravcomp inertia invweight0 ipos iquat mass pos quat
cam_: fovy intrinsic pos quat resolution sensorsize
dof_: armature damping dampingpoly frictionloss invweight0 solimp solref
eq_: active0 data solimp solref
geom_: conaffinity condim friction margin pos priority quat rbound rgba size solimp solmix solref
hfield_: data size
jnt_: actfrclimited actfrcrange actgravcomp axis limited margin pos range solimp solref stiffness stiffnesspoly
mat_: rgba
mesh_: vert
opt.: cone density disableactuator disableflags enableflags gravity impratio integrator iterations ls_iterations
    ls_tolerance magnetic o_friction o_margin o_solimp o_solref solver timestep tolerance viscosity wind
pair_: dim friction margin solimp solref solreffriction
qpos_: spring
sensor_: cutoff
site_: pos quat size
stat.: meaninertia
tendon_: actfrclimited actfrcrange armature damping dampingpoly frictionloss invweight0 length0 lengthspring limited
    margin range solimp_fri solimp_lim solref_fri solref_lim stiffness stiffnesspoly
wrap_: prm
""")
"""Fields that rollouts read: with other values they end elsewhere."""

PLACES = _names("""
-: na nactuator nbody ncam neq nexclude ngeom nhfield nhfielddata njnt nmat nmesh nmeshface nmeshgraph nmeshvert nmocap
    npair nq nsensor nsensordata nsite ntendon nu nv nwrap
actuator_: actadr actnum biastype ctrladr ctrlnum dyntype gaintype outadr outnum trnid trntype
body_: dofadr dofnum geomadr geomnum jntadr jntnum mocapid parentid rootid weldid
cam_: bodyid mode targetbodyid
dof_: bodyid jntid parentid
eq_: obj1id obj2id objtype type
exclude_: signature
geom_: bodyid contype dataid matid type
hfield_: adr ncol nrow
jnt_: actuatorid bodyid dofadr qposadr type
mesh_: face faceadr facenum graph graphadr polyadr polynormal polynum polyvert polyvertadr polyvertnum vertadr vertnum
pair_: geom1 geom2
sensor_: adr datatype dim intprm objid objtype refid reftype type
site_: bodyid type
tendon_: actuatorid adr num type
wrap_: objid type
""")
"""Fields that rollouts read, too: places, counts and kinds, which belong to each other and are not changed alone."""

FOLLOWS = _names("""
-: flg_adhesion flg_gravcomp flg_surfacevel mapD2M mapM2D mapM2M nB nC nD nJmom nJten nM nbvh nbvhdynamic nbvhstatic
    nefm0L nefm0dof nefmCvert nemax ngravcomp nmeshdegmax nmeshpoly nmeshpolymap nmeshpolyvert noct npolygonmax ntree
B_: colind rowadr rownnz
D_: colind diag rowadr rownnz
M_: colind rowadr rownnz
actuator_: length0
body_: bvhadr bvhnum conaffinity contype sameframe simple subtreemass treeid
bvh_: aabb child depth nodeid
cam_: mat0 pos0 poscom0
dof_: M0 Madr length simplenum treeid
efm0_: L L_colind L_rowadr L_rownnz dofid
efmC_: perm
geom_: aabb sameframe
mesh_: bvhadr bvhnum extrema octadr octnum polymap polymapadr polymapnum pos quat scale
oct_: aabb child coeff depth
opt.: ccd_iterations ccd_tolerance
pair_: signature
sensor_: needstage
site_: sameframe
ten_: J_colind J_rowadr J_rownnz
tendon_: treeid treenum
tree_: bodyadr bodynum dofadr dofnum sleep_policy
""")
"""Fields that MuJoCo derives from the others, or that say how it finds what it finds: not read, and not compared."""

REFUSED = _names("""
-: nJfe nJfv nflex nflexbending nflexedge nflexelem nflexelemdata nflexelemedge nflexnode nflexshelldata
    nflexstiffness nflextexcoord nflexvert nhistory nplastic nplugin npluginattr npluginstate plugin
actuator_: ctrlspec delay history historyadr plugin
body_: plugin
flex_: activelayers bending bendingadr bvhadr bvhnum cellnum centered conaffinity condim contype damping dim edge
    edgeadr edgedamping edgeequality edgeflap edgenum edgestiffness elem elemadr elemdataadr elemedge elemedgeadr
    elemlayer elemnum elemtexcoord flatskin friction gap interp margin node node0 nodeadr nodebodyid nodenum passive
    plasticadr plasticmode priority radius rigid selfcollide shell shelldataadr shellnum size solimp solmix solref
    stiffness stiffnessadr texcoord texcoordadr vert vert0 vertadr vertbodyid vertcell vertedge vertedgeadr
    vertedgenum vertmetric vertnum yield
flexedge_: J_colind J_rowadr J_rownnz invweight0 length0 rigid
flexvert_: J_colind J_rowadr J_rownnz
geom_: adhesion fluid gap plugin surfacevel
jnt_: plasticadr springyield
opt.: noslip_iterations noslip_tolerance sdf_initpoints sdf_iterations sleep_tolerance
pair_: adhesion gap
plugin_: attr attradr stateadr statenum
sensor_: delay history historyadr interval plugin
tendon_: plasticadr springyield
""")
"""Fields of what rollouts lack: a model that uses one is refused by name, or MuJoCo rolls it out."""

WITHOUT_EFFECT = _names("""
-: name_actuatoradr name_bodyadr name_camadr name_eqadr name_excludeadr name_flexadr name_geomadr name_hfieldadr
    name_jntadr name_keyadr name_lightadr name_matadr name_meshadr name_numericadr name_pairadr name_pluginadr
    name_sensoradr name_siteadr name_skinadr name_tendonadr name_texadr name_textadr name_tupleadr names names_map
    narena nbuffer nconmax njmax nkey nlight nmeshnormal nmeshtexcoord nnames nnames_map nnumeric nnumericdata
    nout npaths nskin nskinbone nskinbonevert nskinface nskintexvert nskinvert ntex ntexdata ntext ntextdata ntuple
    ntupledata numeric_adr numeric_data numeric_size nuser_actuator nuser_body nuser_cam nuser_geom nuser_jnt
    nuser_sensor nuser_site nuser_tendon nuserdata paths signature
actuator_: user
body_: margin user
cam_: ipd output projection user
flex_: group matid rgba
geom_: castshadow group user
hfield_: pathadr
jnt_: group user
key_: act ctrl mpos mquat plastic qpos qvel time
light_: active ambient attenuation bodyid bulbradius castshadow cutoff diffuse dir dir0 exponent intensity mode pos
    pos0 poscom0 range softness specular targetbodyid texid type
mat_: emission metallic reflectance roughness shininess specular texid texrepeat texuniform
mesh_: facenormal facetexcoord normal normaladr normalnum pathadr texcoord texcoordadr texcoordnum
opt.: jacobian
sensor_: noise user
site_: dataid group matid rgba user
skin_: boneadr bonebindpos bonebindquat bonebodyid bonenum bonevertadr bonevertid bonevertnum bonevertweight face
    faceadr facenum group inflate matid pathadr rgba texcoord texcoordadr vert vertadr vertnum
stat.: center extent meanmass meansize
tendon_: group matid rgba user width
tex_: adr colorspace contenttypeadr data height nchannel pathadr type width
text_: adr data size
tuple_: adr objid objprm objtype size
""")
"""Fields without effect on physics."""


def says_something(name: str) -> bool:
    """Return whether a field may change a rollout, so that models which differ in it are different ones."""
    return name not in FOLLOWS and name not in WITHOUT_EFFECT


VARYING = (
    "body_mass",
    "body_inertia",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "tendon_invweight0",
    "geom_friction",
    "geom_size",
    "geom_aabb",
    "geom_rbound",
    "actuator_acc0",
)
"""Arrays in which the worlds of a batch may differ; those that MuJoCo derives from the others among them."""
_VECTORS = ("opt.gravity", "opt.wind", "opt.magnetic", "opt.o_solref", "opt.o_solimp", "opt.o_friction")
"""Options that are arrays."""
_NUMBERS = operator.attrgetter(
    *(
        name
        for name in (*(f"opt.{own}" for own in dir(mujoco.MjOption) if not own.startswith("_")), "stat.meaninertia")
        if name not in _VECTORS and says_something(name)
    )
)
_NEAR = 64
"""Bytes between arrays of one piece of memory at most, by which MuJoCo aligns them."""


class _Views:
    """The memory of a model's arrays: those that may differ between worlds, and pieces with all others.

    Args:
        model: The model, which must live as long as the views are read.
    """

    def __init__(self, model: mujoco.MjModel):
        self.model = weakref.ref(model)
        self.varying = [getattr(model, name) for name in VARYING]
        self._varying = [_span(values) for values in self.varying]
        self._parts = SimpleNamespace(opt=model.opt, stat=model.stat)  # the model itself is not held
        self._vectors = [operator.attrgetter(name)(model) for name in _VECTORS]
        spans = sorted(
            _span(value)
            for name in dir(model)
            if not name.startswith(("_",) if _meshes_touch(model) else ("_", "mesh_"))
            if name not in VARYING and says_something(name)
            if isinstance(value := getattr(model, name), np.ndarray) and value.nbytes
        )
        pieces: list[list[int]] = []
        for at, size in spans:
            if pieces and 0 <= at - pieces[-1][1] < _NEAR:
                pieces[-1][1] = at + size
            else:
                pieces.append([at, at + size])
        self._pieces = [(start, end - start) for start, end in pieces]

    def fixed(self) -> tuple[list[bytes], tuple]:
        """Pieces of memory and options that may not differ between worlds."""
        vectors = [vector.tobytes() for vector in self._vectors]
        return [*vectors, *(ctypes.string_at(*piece) for piece in self._pieces)], _NUMBERS(self._parts)

    def differing(self, others: Sequence[_Views]) -> list[int]:
        """Indices of the arrays that may differ between worlds and are others in some of these models."""
        own = [ctypes.string_at(*span) for span in self._varying]
        return [n for n, one in enumerate(own) if any(ctypes.string_at(*o._varying[n]) != one for o in others)]


def _meshes_touch(m: mujoco.MjModel) -> bool:
    """Return whether some geom is a mesh that may touch anything: others are large, and not read."""
    may = (m.geom_contype | m.geom_conaffinity) != 0
    may[m.pair_geom1], may[m.pair_geom2] = True, True
    return bool((may & (m.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH))).any())


def _span(values: np.ndarray) -> tuple[int, int]:
    """Address and size of an array [bytes]."""
    return values.__array_interface__["data"][0], values.nbytes


def _differing(model: mujoco.MjModel, other: mujoco.MjModel) -> Iterator[str]:
    """Names of what may not differ between worlds and is another in two models."""
    options = (f"opt.{name}" for name in dir(mujoco.MjOption))
    for name in (*dir(model), *options):
        if not name.startswith(("_", "opt._")) and name not in VARYING and says_something(name):
            values, others = (operator.attrgetter(name)(one) for one in (model, other))
            if isinstance(values, np.ndarray | float | int) and not np.array_equal(values, others):
                yield name


class _Known:
    """A copy of a model's numbers, and its key."""

    def __init__(self, views: _Views):
        self.pieces, self.options = views.fixed()
        out = hashlib.blake2b(repr(self.options).encode(), digest_size=16)
        for piece in self.pieces:
            out.update(piece)
        self.key = out.digest()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Views):
            return NotImplemented
        return other.fixed() == (self.pieces, self.options)

    __hash__ = None


class ModelNumbers:
    """Tells models apart, at each look: their numbers may have been changed since the last."""

    def __init__(self) -> None:
        self._views: dict[int, _Views] = {}
        self._known: _Known | None = None

    def of(self, models: Sequence[mujoco.MjModel]) -> tuple[bytes, dict[str, np.ndarray] | str]:
        """Return a key of the first model, and what differs between all.

        Args:
            models: One for all worlds, or one for each.

        Returns:
            A key that other models share which can roll out in one batch, and the arrays that differ, ``[W, ...]``
            each; or in their place the names of what may not differ and does.
        """
        several = len({id(model) for model in models}) > 1
        views = [self._view(model) for model in (models if several else models[:1])]
        if self._known is None or self._known != views[0]:
            del self._views[id(models[0])]  # other geoms may touch now
            views[0] = self._view(models[0])
            self._known = _Known(views[0])
        arrays: dict[str, np.ndarray] | str = {}
        if several:
            other = next((model for model, view in zip(models, views, strict=True) if self._known != view), None)
            if other is not None:
                arrays = ", ".join(_differing(models[0], other))
            else:
                stacked = ((i, np.stack([v.varying[i] for v in views])) for i in views[0].differing(views[1:]))
                arrays = {VARYING[i]: values for i, values in stacked if (values != values[:1]).any()}
        out = hashlib.blake2b(self._known.key, digest_size=16)
        for name, values in zip(VARYING, views[0].varying, strict=True):
            out.update(b"" if name in arrays else values.tobytes())
        return out.digest(), arrays

    def _view(self, model: mujoco.MjModel) -> _Views:
        found = self._views.get(id(model))
        if found is None or found.model() is not model:
            self._views = {key: view for key, view in self._views.items() if view.model() is not None}
            found = self._views[id(model)] = _Views(model)
        return found
