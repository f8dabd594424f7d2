"""A small robot in two files: a leg (thigh, shank with a welded foot) with a gear at each joint."""

URDF = """\
<robot name="leg">
  <material name="red"><color rgba="1 0 0 1"/></material>
  <link name="trunk">
    <inertial><mass value="5"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
  </link>
  <link name="thigh">
    <inertial><mass value="2"/><inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.02"/></inertial>
  </link>
  <link name="shank">
    <inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
  </link>
  <link name="foot"/>
  <joint name="hip" type="revolute">
    <parent link="trunk"/><child link="thigh"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="2" effort="30" velocity="20"/>
  </joint>
  <joint name="knee" type="revolute">
    <parent link="thigh"/><child link="shank"/><origin xyz="0 0 -0.2"/><axis xyz="0 1 0"/>
  </joint>
  <joint name="ankle" type="fixed"><parent link="shank"/><child link="foot"/><origin xyz="0 0 -0.3"/></joint>
</robot>
"""

YAML = """\
urdf: leg.urdf
base: floating
rotors:
  hip_rotor:
    parent: trunk
    xyz: [0, 0, 0]
    axis: [0, 1, 0]
    mass: 0.1
    inertia: [1e-4, 0, 0, 2e-4, 0, 1e-4]
    ratios: {thigh: 6}
  knee_rotor:
    parent: thigh
    xyz: [0, 0, 0]
    axis: [0, 1, 0]
    mass: 0.1
    inertia: [1e-4, 0, 0, 2e-4, 0, 1e-4]
    ratios: {shank: 8}
motors:
  hip_rotor: {torque: 3}
contacts:
  toe: {body: foot, position: [0, 0, 0], radius: 0.02}
pose: {height: 0.52, joints: {thigh: 0.1}}
gains: {kp: 20, kd: {thigh: 1, shank: 2}}
"""
