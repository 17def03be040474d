<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.34">
  <!-- The hatch over what is uncertain: style.py fills in rule and colour. Lines run on from tile to tile. The rule
       is on their style, not on the layer: legends, which have no feature, would show a layer in each class. -->
  <symbol type="fill" name="0" alpha="1" clip_to_extent="1" force_rhr="0" is_animated="0" frame_rate="10">
    <layer class="LinePatternFill" enabled="1" pass="0" locked="0">
      <Option type="Map">
        <Option name="angle" type="QString" value="-45" />
        <Option name="clip_mode" type="QString" value="during_render" />
        <Option name="color" type="QString" value="0,0,0,255" />
        <Option name="coordinate_reference" type="QString" value="viewport" />
        <Option name="distance" type="QString" value="1.3" />
        <Option name="distance_unit" type="QString" value="MM" />
      </Option>
      <symbol type="line" name="@0@0" alpha="1" clip_to_extent="1" force_rhr="0" is_animated="0" frame_rate="10">
        <layer class="SimpleLine" enabled="1" pass="0" locked="0">
          <Option type="Map">
            <Option name="capstyle" type="QString" value="flat" />
            <Option name="line_color" type="QString" value="0,0,0,255" />
            <Option name="line_style" type="QString" value="no" />
            <Option name="line_width" type="QString" value="0.3" />
            <Option name="line_width_unit" type="QString" value="MM" />
          </Option>
          <data_defined_properties>
            <Option type="Map">
              <Option name="name" type="QString" value="" />
              <Option name="properties" type="Map">
                <Option name="outlineStyle" type="Map">
                  <Option name="active" type="bool" value="true" />
                  <Option name="expression" type="QString" value="" />
                  <Option name="type" type="int" value="3" />
                </Option>
              </Option>
              <Option name="type" type="QString" value="collection" />
            </Option>
          </data_defined_properties>
        </layer>
      </symbol>
    </layer>
  </symbol>
</qgis>
