<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.34" styleCategories="Symbology|Labeling|Fields|MapTips" labelsEnabled="1">
  <renderer-v2 type="singleSymbol" symbollevels="0">
    <symbols>
      <symbol type="line" name="0" alpha="1" clip_to_extent="1" force_rhr="0">
        <layer class="SimpleLine" enabled="1" pass="0">
          <Option type="Map">
            <Option name="line_color" type="QString" value="17,24,39,140" />
            <Option name="line_width" type="QString" value="0.18" />
            <Option name="line_width_unit" type="QString" value="MM" />
          </Option>
        </layer>
        <!-- An arrow where the lane ends. -->
        <layer class="MarkerLine" enabled="1" pass="0">
          <Option type="Map">
            <Option name="placements" type="QString" value="LastVertex" />
            <Option name="rotate" type="QString" value="1" />
          </Option>
          <symbol type="marker" name="@0@1" alpha="1" clip_to_extent="1" force_rhr="0">
            <layer class="SimpleMarker" enabled="1" pass="0">
              <Option type="Map">
                <Option name="name" type="QString" value="filled_arrowhead" />
                <Option name="size" type="QString" value="1.8" />
                <Option name="color" type="QString" value="17,24,39,255" />
                <Option name="outline_style" type="QString" value="no" />
              </Option>
            </layer>
          </symbol>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <labeling type="simple">
    <settings>
      <text-style fieldName="lane" isExpression="0" fontSize="7.5" fontSizeUnit="Point" fontFamily="Open Sans" fontWeight="75" namedStyle="Bold" textColor="17,24,39,255" textOpacity="1">
        <text-buffer bufferDraw="1" bufferSize="0.7" bufferSizeUnits="MM" bufferColor="255,255,255,255" bufferOpacity="0.92" bufferJoinStyle="128" />
      </text-style>
      <!-- On the lane, along it; beyond its ends where it is shorter than its number; none is left out. -->
      <placement placement="2" placementFlags="9" dist="0" distUnits="MM" overrunDistance="8" overrunDistanceUnit="MM" lineAnchorPercent="0.5" lineAnchorType="0" lineAnchorClipping="0" priority="9" overlapHandling="AllowOverlapIfRequired" allowDegraded="1" />
      <rendering drawLabels="1" obstacle="0" scaleVisibility="0" labelPerPart="0" mergeLines="0" minFeatureSize="0" limitNumLabels="0" upsidedownLabels="0" unplacedVisibility="0" />
    </settings>
  </labeling>
  <aliases>
    <alias index="0" field="lane" name="Lane" />
    <alias index="1" field="lanelets" name="Lanelets" />
    <alias index="2" field="subtype" name="Kind" />
    <alias index="3" field="street" name="Street" />
    <alias index="4" field="street_part" name="Which street of that name" />
    <alias index="5" field="direction" name="Leads to the" />
    <alias index="6" field="turn" name="Turns" />
    <alias index="7" field="stop_line_m" name="Stop line after (m)" />
    <alias index="8" field="length_m" name="Length (m)" />
  </aliases>
  <previewExpression>"lane"</previewExpression>
  <mapTip enabled="1">&lt;b&gt;[% "lane" %]&lt;/b&gt;[% coalesce(' ' || "street", '') %][% coalesce(' (' || "street_part" || ')', '') %]&lt;br&gt;[% "direction" %][% coalesce(', ' || "turn", '') %], [% format_number("length_m", 0) %] m</mapTip>
  <layerGeometryType>1</layerGeometryType>
</qgis>
