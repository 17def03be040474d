<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.34" styleCategories="Symbology|Temporal" labelsEnabled="0">
  <!-- A row is shown from its begin for half a second, less 10 ms: QGIS compares times as text and would show the next row, too. -->
  <temporal enabled="1" mode="1" limitMode="0" startField="begin" endField="end" fixedDuration="490" durationUnit="ms" durationField="" accumulate="0" startExpression="" endExpression="" />
  <!-- Cool colours, unlike those of shares of time; hollow where a vehicle stands, pale where its place is inferred. -->
  <renderer-v2 type="categorizedSymbol" attr="&quot;kind&quot; || ', ' || &quot;state&quot;" symbollevels="0" forceraster="0" enableorderby="0">
    <categories>
      <category symbol="0" value="light, moving" label="light vehicle, moving" render="true" />
      <category symbol="1" value="light, standing" label="light vehicle, standing" render="true" />
      <category symbol="2" value="heavy, moving" label="heavy vehicle (over 3.5 t), moving" render="true" />
      <category symbol="3" value="heavy, standing" label="heavy vehicle, standing" render="true" />
    </categories>
    <symbols>
      <symbol type="fill" name="0" alpha="1" clip_to_extent="1" force_rhr="0">
        <data_defined_properties>
          <Option type="Map">
            <Option name="properties" type="Map">
              <Option name="alpha" type="Map">
                <Option name="active" type="bool" value="true" />
                <Option name="expression" type="QString" value="if(&quot;seen&quot;, 100, 45)" />
                <Option name="type" type="int" value="3" />
              </Option>
            </Option>
            <Option name="type" type="QString" value="collection" />
          </Option>
        </data_defined_properties>
        <layer class="SimpleFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="color" type="QString" value="0,120,215,255" />
            <Option name="style" type="QString" value="solid" />
            <Option name="outline_color" type="QString" value="255,255,255,255" />
            <Option name="outline_style" type="QString" value="solid" />
            <Option name="outline_width" type="QString" value="0.3" />
            <Option name="outline_width_unit" type="QString" value="MM" />
            <Option name="joinstyle" type="QString" value="miter" />
          </Option>
        </layer>
        <layer class="CentroidFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="point_on_surface" type="QString" value="0" />
          </Option>
          <symbol type="marker" name="@0@1" alpha="1" clip_to_extent="1" force_rhr="0">
            <layer class="SimpleMarker" enabled="1" pass="0">
              <Option type="Map">
                <Option name="name" type="QString" value="equilateral_triangle" />
                <Option name="color" type="QString" value="255,255,255,255" />
                <Option name="outline_style" type="QString" value="no" />
                <Option name="size" type="QString" value="1.6" />
                <Option name="size_unit" type="QString" value="MapUnit" />
              </Option>
              <data_defined_properties>
                <Option type="Map">
                  <Option name="properties" type="Map">
                    <Option name="angle" type="Map">
                      <Option name="active" type="bool" value="true" />
                      <Option name="expression" type="QString" value="90 - &quot;heading&quot;" />
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
      <symbol type="fill" name="1" alpha="1" clip_to_extent="1" force_rhr="0">
        <data_defined_properties>
          <Option type="Map">
            <Option name="properties" type="Map">
              <Option name="alpha" type="Map">
                <Option name="active" type="bool" value="true" />
                <Option name="expression" type="QString" value="if(&quot;seen&quot;, 100, 45)" />
                <Option name="type" type="int" value="3" />
              </Option>
            </Option>
            <Option name="type" type="QString" value="collection" />
          </Option>
        </data_defined_properties>
        <layer class="SimpleFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="color" type="QString" value="255,255,255,255" />
            <Option name="style" type="QString" value="solid" />
            <Option name="outline_color" type="QString" value="0,120,215,255" />
            <Option name="outline_style" type="QString" value="solid" />
            <Option name="outline_width" type="QString" value="0.45" />
            <Option name="outline_width_unit" type="QString" value="MM" />
            <Option name="joinstyle" type="QString" value="miter" />
          </Option>
        </layer>
        <layer class="CentroidFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="point_on_surface" type="QString" value="0" />
          </Option>
          <symbol type="marker" name="@1@1" alpha="1" clip_to_extent="1" force_rhr="0">
            <layer class="SimpleMarker" enabled="1" pass="0">
              <Option type="Map">
                <Option name="name" type="QString" value="equilateral_triangle" />
                <Option name="color" type="QString" value="0,120,215,255" />
                <Option name="outline_style" type="QString" value="no" />
                <Option name="size" type="QString" value="1.6" />
                <Option name="size_unit" type="QString" value="MapUnit" />
              </Option>
              <data_defined_properties>
                <Option type="Map">
                  <Option name="properties" type="Map">
                    <Option name="angle" type="Map">
                      <Option name="active" type="bool" value="true" />
                      <Option name="expression" type="QString" value="90 - &quot;heading&quot;" />
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
      <symbol type="fill" name="2" alpha="1" clip_to_extent="1" force_rhr="0">
        <data_defined_properties>
          <Option type="Map">
            <Option name="properties" type="Map">
              <Option name="alpha" type="Map">
                <Option name="active" type="bool" value="true" />
                <Option name="expression" type="QString" value="if(&quot;seen&quot;, 100, 45)" />
                <Option name="type" type="int" value="3" />
              </Option>
            </Option>
            <Option name="type" type="QString" value="collection" />
          </Option>
        </data_defined_properties>
        <layer class="SimpleFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="color" type="QString" value="0,74,46,255" />
            <Option name="style" type="QString" value="solid" />
            <Option name="outline_color" type="QString" value="255,255,255,255" />
            <Option name="outline_style" type="QString" value="solid" />
            <Option name="outline_width" type="QString" value="0.3" />
            <Option name="outline_width_unit" type="QString" value="MM" />
            <Option name="joinstyle" type="QString" value="miter" />
          </Option>
        </layer>
        <layer class="CentroidFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="point_on_surface" type="QString" value="0" />
          </Option>
          <symbol type="marker" name="@2@1" alpha="1" clip_to_extent="1" force_rhr="0">
            <layer class="SimpleMarker" enabled="1" pass="0">
              <Option type="Map">
                <Option name="name" type="QString" value="equilateral_triangle" />
                <Option name="color" type="QString" value="255,255,255,255" />
                <Option name="outline_style" type="QString" value="no" />
                <Option name="size" type="QString" value="1.6" />
                <Option name="size_unit" type="QString" value="MapUnit" />
              </Option>
              <data_defined_properties>
                <Option type="Map">
                  <Option name="properties" type="Map">
                    <Option name="angle" type="Map">
                      <Option name="active" type="bool" value="true" />
                      <Option name="expression" type="QString" value="90 - &quot;heading&quot;" />
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
      <symbol type="fill" name="3" alpha="1" clip_to_extent="1" force_rhr="0">
        <data_defined_properties>
          <Option type="Map">
            <Option name="properties" type="Map">
              <Option name="alpha" type="Map">
                <Option name="active" type="bool" value="true" />
                <Option name="expression" type="QString" value="if(&quot;seen&quot;, 100, 45)" />
                <Option name="type" type="int" value="3" />
              </Option>
            </Option>
            <Option name="type" type="QString" value="collection" />
          </Option>
        </data_defined_properties>
        <layer class="SimpleFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="color" type="QString" value="255,255,255,255" />
            <Option name="style" type="QString" value="solid" />
            <Option name="outline_color" type="QString" value="0,74,46,255" />
            <Option name="outline_style" type="QString" value="solid" />
            <Option name="outline_width" type="QString" value="0.45" />
            <Option name="outline_width_unit" type="QString" value="MM" />
            <Option name="joinstyle" type="QString" value="miter" />
          </Option>
        </layer>
        <layer class="CentroidFill" enabled="1" pass="0">
          <Option type="Map">
            <Option name="point_on_surface" type="QString" value="0" />
          </Option>
          <symbol type="marker" name="@3@1" alpha="1" clip_to_extent="1" force_rhr="0">
            <layer class="SimpleMarker" enabled="1" pass="0">
              <Option type="Map">
                <Option name="name" type="QString" value="equilateral_triangle" />
                <Option name="color" type="QString" value="0,74,46,255" />
                <Option name="outline_style" type="QString" value="no" />
                <Option name="size" type="QString" value="1.6" />
                <Option name="size_unit" type="QString" value="MapUnit" />
              </Option>
              <data_defined_properties>
                <Option type="Map">
                  <Option name="properties" type="Map">
                    <Option name="angle" type="Map">
                      <Option name="active" type="bool" value="true" />
                      <Option name="expression" type="QString" value="90 - &quot;heading&quot;" />
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
    </symbols>
  </renderer-v2>
  <aliases>
    <alias index="0" field="vehicle" name="Vehicle" />
    <alias index="1" field="begin" name="Begin (UTC)" />
    <alias index="2" field="end" name="End (UTC)" />
    <alias index="3" field="kind" name="Kind" />
    <alias index="4" field="state" name="State" />
    <alias index="5" field="speed_kmh" name="Speed (km/h)" />
    <alias index="6" field="heading" name="Heading (deg)" />
    <alias index="7" field="length_m" name="Length (m)" />
    <alias index="8" field="width_m" name="Width (m)" />
    <alias index="9" field="lanelet_id" name="Lanelet" />
    <alias index="10" field="seen" name="Seen" />
  </aliases>
  <layerGeometryType>2</layerGeometryType>
</qgis>
