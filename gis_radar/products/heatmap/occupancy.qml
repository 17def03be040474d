<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.34" styleCategories="Symbology|Temporal|Fields|MapTips">
  <!-- The classes are filled in by style.py: an item, a range and a symbol each, like the ones here. -->
  <pipe>
    <rasterrenderer type="singlebandpseudocolor" band="1" opacity="1" alphaBand="-1" classificationMin="0" classificationMax="1" nodataColor="">
      <rastershader>
        <colorrampshader colorRampType="DISCRETE" classificationMode="1" clip="0" minimumValue="0" maximumValue="1" labelPrecision="3">
          <item value="0" color="#000000" alpha="255" label="" />
        </colorrampshader>
      </rastershader>
    </rasterrenderer>
  </pipe>
  <!-- A row is shown from its begin for a fixed time. -->
  <temporal enabled="1" mode="1" limitMode="0" startField="begin" endField="end" fixedDuration="0" durationUnit="ms" durationField="" accumulate="0" startExpression="" endExpression="" />
  <renderer-v2 type="graduatedSymbol" attr="hit_share" symbollevels="0" graduatedMethod="GraduatedColor" forceraster="0" enableorderby="1">
    <ranges>
      <range symbol="0" render="true" label="" lower="0" upper="0" />
    </ranges>
    <symbols>
      <symbol type="fill" name="0" alpha="1" clip_to_extent="1" force_rhr="0" is_animated="0" frame_rate="10">
        <layer class="SimpleFill" enabled="1" pass="0">
          <!-- The outline closes the hairlines between neighbours. -->
          <Option type="Map">
            <Option name="color" type="QString" value="0,0,0,255" />
            <Option name="style" type="QString" value="solid" />
            <Option name="outline_color" type="QString" value="0,0,0,255" />
            <Option name="outline_style" type="QString" value="solid" />
            <Option name="outline_width" type="QString" value="0.1" />
            <Option name="outline_width_unit" type="QString" value="MM" />
          </Option>
        </layer>
      </symbol>
    </symbols>
    <!-- Where tiles overlap, the busiest is on top. -->
    <orderby>
      <orderByClause asc="1" nullsFirst="1">"hit_share"</orderByClause>
    </orderby>
  </renderer-v2>
  <!-- Filled in by style.py. -->
  <aliases />
  <mapTip enabled="1" />
  <layerGeometryType>2</layerGeometryType>
</qgis>
