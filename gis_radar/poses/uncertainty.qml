<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.34" styleCategories="Symbology" labelsEnabled="0">
  <renderer-v2 type="singleSymbol" symbollevels="0">
    <symbols>
      <symbol type="fill" name="0" alpha="1" clip_to_extent="1" force_rhr="0">
        <layer class="SimpleFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="style" type="QString" value="solid" />
            <Option name="color" type="QString" value="29,78,216,60" />
            <Option name="outline_color" type="QString" value="17,24,39,255" />
            <Option name="outline_width" type="QString" value="0.3" />
          </Option>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <aliases>
    <alias index="0" field="sensor" name="Sensor" />
    <alias index="1" field="sigma_easting" name="Easting, standard error (m)" />
    <alias index="2" field="sigma_northing" name="Northing, standard error (m)" />
  </aliases>
  <layerGeometryType>2</layerGeometryType>
</qgis>
