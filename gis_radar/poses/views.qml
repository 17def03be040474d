<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.34" styleCategories="Symbology" labelsEnabled="0">
  <renderer-v2 type="singleSymbol" symbollevels="0">
    <symbols>
      <symbol type="fill" name="0" alpha="1" clip_to_extent="1" force_rhr="0">
        <layer class="SimpleFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="style" type="QString" value="no" />
            <Option name="color" type="QString" value="29,78,216,255" />
            <Option name="outline_color" type="QString" value="29,78,216,255" />
            <Option name="outline_style" type="QString" value="dash" />
            <Option name="outline_width" type="QString" value="0.4" />
          </Option>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <aliases>
    <alias index="0" field="sensor" name="Sensor" />
    <alias index="1" field="azimuth_deg" name="Azimuth (deg)" />
    <alias index="2" field="elevation_deg" name="Elevation (deg)" />
    <alias index="3" field="min_range_m" name="Least range (m)" />
    <alias index="4" field="max_range_m" name="Greatest range (m)" />
  </aliases>
  <layerGeometryType>2</layerGeometryType>
</qgis>
