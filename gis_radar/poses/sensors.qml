<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.34" styleCategories="Symbology|Labeling" labelsEnabled="1">
  <renderer-v2 type="singleSymbol" symbollevels="0">
    <symbols>
      <symbol type="marker" name="0" alpha="1" clip_to_extent="1" force_rhr="0">
        <!-- An arrow along yaw: a marker turns clockwise from up, yaw counter-clockwise from east. -->
        <layer class="SimpleMarker" enabled="1" pass="0">
          <Option type="Map">
            <Option name="name" type="QString" value="arrow" />
            <Option name="size" type="QString" value="8" />
            <Option name="color" type="QString" value="29,78,216,255" />
            <Option name="outline_color" type="QString" value="255,255,255,255" />
            <Option name="outline_width" type="QString" value="0.4" />
            <Option name="vertical_anchor_point" type="QString" value="2" />
          </Option>
          <data_defined_properties>
            <Option type="Map">
              <Option name="properties" type="Map">
                <Option name="angle" type="Map">
                  <Option name="active" type="bool" value="true" />
                  <Option name="expression" type="QString" value="90 - &quot;yaw&quot;" />
                  <Option name="type" type="int" value="3" />
                </Option>
              </Option>
              <Option name="type" type="QString" value="collection" />
            </Option>
          </data_defined_properties>
        </layer>
        <layer class="SimpleMarker" enabled="1" pass="0">
          <Option type="Map">
            <Option name="name" type="QString" value="circle" />
            <Option name="size" type="QString" value="2.6" />
            <Option name="color" type="QString" value="17,24,39,255" />
            <Option name="outline_color" type="QString" value="255,255,255,255" />
          </Option>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <labeling type="simple">
    <settings>
      <text-style fieldName="&quot;sensor&quot; || coalesce(' ± ' || format_number(sqrt(&quot;sigma_easting&quot;^2 + &quot;sigma_northing&quot;^2), 2) || ' m', '')" isExpression="1" fontSize="9" fontSizeUnit="Point" fontFamily="Open Sans" fontWeight="75" namedStyle="Bold" textColor="17,24,39,255" textOpacity="1">
        <text-buffer bufferDraw="1" bufferSize="0.9" bufferSizeUnits="MM" bufferColor="255,255,255,255" bufferOpacity="0.9" bufferJoinStyle="128" />
      </text-style>
      <placement placement="6" offsetType="0" dist="2.5" distUnits="MM" predefinedPositionOrder="R,TR,BR,T,B,TL,BL,L" priority="10" overlapHandling="AllowOverlapIfRequired" />
      <rendering drawLabels="1" obstacle="0" scaleVisibility="0" />
      <!-- The label stands behind its sensor, so that it leaves the arrow free; where that is beyond the map's edge, as near to there as fits: by eighths of a turn from east. -->
      <dd_properties>
        <Option type="Map">
          <Option name="properties" type="Map">
            <Option name="PredefinedPositionOrder" type="Map">
              <Option name="active" type="bool" value="true" />
              <Option name="expression" type="QString" value="array_to_string(array_foreach(array(0, 1, 7, 2, 6, 3, 5, 4), array_get(array('R', 'TR', 'T', 'TL', 'L', 'BL', 'B', 'BR'), (round(((&quot;yaw&quot; + 900) % 360) / 45) + @element) % 8)))" />
              <Option name="type" type="int" value="3" />
            </Option>
          </Option>
          <Option name="type" type="QString" value="collection" />
        </Option>
      </dd_properties>
    </settings>
  </labeling>
  <aliases>
    <alias index="0" field="sensor" name="Sensor" />
    <alias index="1" field="easting" name="Easting (m)" />
    <alias index="2" field="northing" name="Northing (m)" />
    <alias index="3" field="height" name="Height (m)" />
    <alias index="4" field="yaw" name="Yaw (deg)" />
    <alias index="5" field="pitch" name="Pitch (deg)" />
    <alias index="6" field="roll" name="Roll (deg)" />
    <alias index="7" field="sigma_easting" name="Easting, standard error (m)" />
    <alias index="8" field="sigma_northing" name="Northing, standard error (m)" />
    <alias index="9" field="sigma_height" name="Height, standard error (m)" />
    <alias index="10" field="sigma_yaw" name="Yaw, standard error (deg)" />
    <alias index="11" field="sigma_pitch" name="Pitch, standard error (deg)" />
    <alias index="12" field="sigma_roll" name="Roll, standard error (deg)" />
    <alias index="13" field="fitness" name="Fitness" />
    <alias index="14" field="converged" name="Converged" />
    <alias index="15" field="observable" name="Observable" />
    <alias index="16" field="method" name="Method" />
    <alias index="17" field="time" name="Time (UTC)" />
    <alias index="18" field="frames" name="Frames" />
    <alias index="19" field="azimuth_deg" name="Azimuth (deg)" />
    <alias index="20" field="elevation_deg" name="Elevation (deg)" />
    <alias index="21" field="min_range_m" name="Least range (m)" />
    <alias index="22" field="max_range_m" name="Greatest range (m)" />
  </aliases>
  <layerGeometryType>0</layerGeometryType>
</qgis>
