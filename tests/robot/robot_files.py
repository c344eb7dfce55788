"""A small robot: a joint that turns, one that slides, and a camera that looks down from the end of it."""

TWO_JOINTS = """<robot name="two">
  <link name="base">
    <collision><origin xyz="0 0 0.05"/><geometry><box size="0.2 0.2 0.1"/></geometry></collision>
  </link>
  <link name="upper">
    <collision>
      <origin xyz="0.15 0 0" rpy="0 1.5707963267948966 0"/><geometry><cylinder radius="0.04" length="0.3"/></geometry>
    </collision>
  </link>
  <link name="slider">
    <collision><geometry><sphere radius="0.05"/></geometry></collision>
    <collision><origin xyz="0.1 0 0"/><geometry><box size="0.02 0.02 0.02"/></geometry></collision>
  </link>
  <link name="camera"/>
  <joint name="turn" type="revolute">
    <parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/><axis xyz="0 0 2"/>
    <limit lower="-3" upper="3"/>
  </joint>
  <joint name="slide" type="prismatic">
    <parent link="upper"/><child link="slider"/><origin xyz="0.3 0 0"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.5"/>
  </joint>
  <joint name="mount" type="fixed">
    <parent link="slider"/><child link="camera"/><origin xyz="0 0 0.2" rpy="3.141592653589793 0 0"/>
  </joint>
</robot>"""
