<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.34" styleCategories="Symbology" labelsEnabled="0">
  <renderer-v2 type="categorizedSymbol" attr="state" symbollevels="1" forceraster="0" enableorderby="0">
    <categories>
      <category symbol="0" value="in sight" label="in sight" render="true" />
      <category symbol="1" value="hidden" label="hidden" render="true" />
    </categories>
    <symbols>
      <symbol type="fill" name="0" alpha="1" clip_to_extent="1" force_rhr="0">
        <layer class="SimpleFill" enabled="1" pass="1">
          <Option type="Map">
            <Option name="style" type="QString" value="solid" />
            <Option name="color" type="QString" value="86,180,233,255" />
            <Option name="outline_style" type="QString" value="no" />
          </Option>
        </layer>
      </symbol>
      <symbol type="fill" name="1" alpha="1" clip_to_extent="1" force_rhr="0">
        <layer class="SimpleFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="style" type="QString" value="solid" />
            <Option name="color" type="QString" value="117,61,40,255" />
            <Option name="outline_style" type="QString" value="no" />
          </Option>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <aliases>
    <alias index="0" field="sensor" name="Sensor" />
    <alias index="1" field="pose" name="Pose" />
    <alias index="2" field="tile_id" name="Tile" />
    <alias index="3" field="state" name="State" />
    <alias index="4" field="hidden_by" name="Hidden by" />
    <alias index="5" field="hidden_at_m" name="Hidden at (m)" />
    <alias index="6" field="covered" name="Covered by the scan" />
  </aliases>
  <layerGeometryType>2</layerGeometryType>
</qgis>
