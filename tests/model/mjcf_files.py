"""MJCF files that the tests of the importer bend: chains, loops, and a hopper with geoms."""

LUMP = '<inertial mass="{m}" pos="{x} 0.02 -0.03" fullinertia="0.02 0.03 0.04 0.001 -0.002 0.003"/>'


def lump(mass: float = 1.0, x: float = 0.1) -> str:
    return LUMP.format(m=mass, x=x)


def bodies(*links: str) -> str:
    """Nest bodies, each the opening content of one, and close them all."""
    return "".join(f"<body {link}" for link in links) + "</body>" * len(links)


# A chain that has everything: joints off the origin, ref, a slide, turned frames, two joints on a body, welded bodies.
CHAIN = bodies(
    f'name="arm" pos="0 0 1" quat="1 0.2 0.1 0.3"><joint name="a" axis="0 1 1" pos="0.1 0.2 0" ref="0.4"/>{lump()}',
    f'name="slider" pos="0.3 0 0"><joint name="s" type="slide" axis="1 1 0" pos="1 2 3" ref="-0.2"/>{lump(2)}',
    f'name="wrist" pos="0 0 0.3" euler="0 0.5 0"><joint name="w1" axis="1 0 0" pos="0 0 .1"/>'
    f'<joint name="w2" axis="0 0 1" pos=".1 0 0" ref="0.1"/>{lump(0.5)}',
    f'name="plate" pos="0 0.1 0" euler="0.3 0 0">{lump(0.3)}',
    f'name="finger" pos="0 0.1 0"><joint name="f" axis="0.6 0 0.8"/>{lump(0.2)}',
)
# A planar four-bar, drawn closed, in the plane y = 0.
BARS = (
    bodies(
        f'name="crank"><joint name="crank" axis="0 1 0"/>{lump()}',
        f'name="rod" pos="0 0 0.3"><joint name="rod" axis="0 1 0"/>{lump()}<site name="tip" pos="0.6 0 0.1"/>',
    )
    + f'<body name="rocker" pos="0.6 0 0"><joint name="rocker" axis="0 1 0"/>{lump()}'
    + '<site name="top" pos="0 0 0.4"/></body>'
)
CONNECT = '<connect name="pin" body1="rod" body2="rocker" anchor="0.6 0 0.1"/>'
# A spatial parallel ankle: a foot with two hinges, two cranks on the shin, two rods.
ANKLE = bodies(
    f'name="cross" pos="0 0 -0.4"><joint name="pitch" axis="0 1 0"/>{lump(0.1)}',
    f'name="foot"><joint name="roll" axis="1 0 0"/>{lump(0.6)}<site name="l2" pos="-0.1 0.05 0.01"/>'
    '<site name="r2" pos="-0.1 -0.05 0.01"/>',
) + "".join(
    f'<body name="{s}_crank" pos="0 {y} -0.1"><joint name="{s}" axis="0 1 0"/>{lump(0.2, -0.02)}'
    f'<site name="{s}1" pos="-0.1 {y} 0.01"/></body>'
    for s, y in (("l", 0.03), ("r", -0.03))
)
RODS = "".join(f'<spatial name="{s}_rod"><site site="{s}1"/><site site="{s}2"/></spatial>' for s in "lr")
SEVEN = bodies(
    *(
        f'name="b{i}" pos="0.1 {0.05 * (-1) ** i} 0.2"><joint name="j{i}" axis="{axis}"/>{lump(0.5)}'
        for i, axis in enumerate(("0 0 1", "1 0 0.3", "0 1 0", "0.2 0 1", "1 1 0", "0 1 0.5", "1 0 0"))
    )
)


def mjcf(world: str, equality: str = "", tendon: str = "", actuator: str = "", extra: str = "") -> str:
    parts = {"worldbody": world, "tendon": tendon, "equality": equality, "actuator": actuator}
    inside = "".join(f"<{tag}>{content}</{tag}>" for tag, content in parts.items())
    return f'<mujoco model="m"><compiler angle="radian" autolimits="true"/>{extra}{inside}</mujoco>'


def parallel(tie: str, error: float) -> str:
    """Return a platform on three parallel cranks; the third repeats the second but for `error` in length and tilt.

    The cranks end on the platform, or are welded to a body that is hinged there.
    """
    tops = {1: 0.4, 2: 0.4 + error}
    pins = "".join(
        f'<body name="pin_{i}" pos="{0.3 * i} 0 {top - 0.4}"><joint axis="0 1 {error}"/>{lump(0.1)}</body>'
        for i, top in tops.items()
    )
    world = f'<body name="crank"><joint name="crank" axis="0 1 0"/>{lump()}<body name="platform" pos="0.1 0 0.4">'
    world += f'<joint axis="0 1 0"/>{lump(2)}{pins if tie == "weld" else ""}</body></body>'
    equality = ""
    for i, top in tops.items():
        world += f'<body name="rod_{i}" pos="{0.3 * i} 0 0"><joint axis="{error} 1 0"/>{lump()}</body>'
        connect = f'<connect body1="rod_{i}" body2="platform" anchor="0.1 0 {top!r}"/>'
        equality += f'<weld body1="rod_{i}" body2="pin_{i}"/>' if tie == "weld" else connect
    return mjcf(world, equality, actuator='<motor joint="crank"/>')


GEOMS = """<worldbody><geom name="floor" type="plane" size="0 0 1" friction="0.6"/>
<body name="trunk" pos="0 0 0.5"><freejoint/>
<geom name="hull" type="box" size="0.2 0.1 0.05" friction="0.6"/><geom name="look" type="sphere" size=".1" contype="0"
 conaffinity="0" group="2"/><body name="leg" pos="0.1 0 0"><joint name="hip" axis="0 1 0" range="-1 2" damping="0.3"/>
<geom name="shin" type="capsule" size="0.02" fromto="0 0 0 0 0 -0.4" friction="0.6"/></body></body></worldbody>"""
ROUGH = 'size="0.2 0.1 0.05" friction="0.6"'


def body(name: str = "b", inside: str = '<joint name="j"/>', geom: str = '<geom size=".1"/>', more: str = "") -> str:
    return f'<body name="{name}">{inside}{geom}{more}</body>'


def plain_mjcf(world: str = body(), rest: str = "") -> str:
    return f"<mujoco><worldbody>{world}</worldbody>{rest}</mujoco>"
