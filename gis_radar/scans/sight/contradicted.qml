<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.34" styleCategories="Symbology" labelsEnabled="0">
  <renderer-v2 type="categorizedSymbol" attr="what" symbollevels="0" forceraster="0" enableorderby="0">
    <categories>
      <category symbol="0" value="nothing moves in sight" label="nothing moves in sight" render="true" />
      <category symbol="1" value="moves where hidden" label="moves where hidden" render="true" />
    </categories>
    <symbols>
      <symbol type="fill" name="0" alpha="1" clip_to_extent="1" force_rhr="0">
        <layer class="SimpleFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="style" type="QString" value="solid" />
            <Option name="color" type="QString" value="213,94,0,255" />
            <Option name="outline_style" type="QString" value="no" />
          </Option>
        </layer>
      </symbol>
      <symbol type="fill" name="1" alpha="1" clip_to_extent="1" force_rhr="0">
        <layer class="SimpleFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="style" type="QString" value="solid" />
            <Option name="color" type="QString" value="240,228,66,255" />
            <Option name="outline_style" type="QString" value="no" />
          </Option>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <layerGeometryType>2</layerGeometryType>
</qgis>
