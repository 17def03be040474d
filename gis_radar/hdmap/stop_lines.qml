<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.34" styleCategories="Symbology|Fields|MapTips" labelsEnabled="0">
  <renderer-v2 type="singleSymbol" symbollevels="0">
    <symbols>
      <symbol type="line" name="0" alpha="1" clip_to_extent="1" force_rhr="0">
        <layer class="SimpleLine" enabled="1" pass="0">
          <Option type="Map">
            <Option name="line_color" type="QString" value="17,24,39,255" />
            <Option name="line_width" type="QString" value="0.5" />
            <Option name="line_width_unit" type="QString" value="MM" />
            <Option name="capstyle" type="QString" value="flat" />
          </Option>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <aliases>
    <alias index="0" field="stop_line" name="Stop line" />
    <alias index="1" field="lane" name="Lane" />
    <alias index="2" field="lanelet_id" name="Lanelet" />
    <alias index="3" field="s_m" name="Along the lanelet (m)" />
    <alias index="4" field="lane_m" name="Along the lane (m)" />
    <alias index="5" field="sign" name="Sign" />
  </aliases>
  <previewExpression>"stop_line"</previewExpression>
  <mapTip enabled="1">&lt;b&gt;[% replace(replace("lane", '&amp;', '&amp;amp;'), '&lt;', '&amp;lt;') %]&lt;/b&gt;, [% format_number("lane_m", 1) %] m</mapTip>
  <layerGeometryType>1</layerGeometryType>
</qgis>
