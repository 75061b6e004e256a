# SPDX-License-Identifier: Apache-2.0
"""Every field of ``MjModel``, ``MjOption`` (``opt.``) and ``MjStatistic`` (``stat.``), and what rollouts make of it.

Caches and comparisons of models look at all fields but those that say nothing (:func:`says_something`). A field that a
newer MuJoCo adds is looked at, too, and fails a test until it is in this table.
"""

from __future__ import annotations


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
