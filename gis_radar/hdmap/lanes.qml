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
  <labeling type="rule-based">
    <rules key="lanes">
      <!-- On the lane, along it, where there is room for five side by side; none is left out.
           The map may have another coordinate system than the lanes. @mm is a millimetre of paper in
           their metres; those of web maps (EPSG:3857) are longer than the ground's, 1.5 times at
           50 degrees north, as is their @map_scale: the areas of the extent in both tell by how much. -->
      <rule key="long" description="long" filter="with_variable('mm', coalesce(@map_scale, 1000) / 1000 * if(@map_crs = 'EPSG:3857', coalesce(try(sqrt(area(transform(@map_extent, @map_crs, @layer_crs)) / area(@map_extent))), 1), 1), @mm &gt; 5 or with_variable('seen', try(intersection($geometry, if(@map_crs = @layer_crs, @map_extent, transform(@map_extent, @map_crs, @layer_crs)))), length(if(is_empty_or_null(@seen), $geometry, @seen)) &gt; @mm * (6 + 6 * length(to_string(&quot;lane&quot;)))))">
        <settings>
          <text-style fieldName="'&#8194;' || &quot;lane&quot; || '&#8194;'" isExpression="1" fontSize="7.5" fontSizeUnit="Point" fontFamily="Open Sans" fontWeight="75" namedStyle="Bold" textColor="17,24,39,255" textOpacity="1">
            <text-buffer bufferDraw="1" bufferSize="0.7" bufferSizeUnits="MM" bufferColor="255,255,255,255" bufferOpacity="0.92" bufferJoinStyle="128" />
          </text-style>
          <placement placement="2" placementFlags="9" dist="0" distUnits="MM" overrunDistance="8" overrunDistanceUnit="MM" lineAnchorPercent="0.5" lineAnchorType="0" lineAnchorClipping="0" priority="9" overlapHandling="AllowOverlapIfRequired" allowDegraded="1" />
          <rendering drawLabels="1" obstacle="0" scaleVisibility="0" labelPerPart="0" mergeLines="0" minFeatureSize="0" limitNumLabels="0" upsidedownLabels="0" unplacedVisibility="0" />
        </settings>
      </rule>
      <!-- Else as near its middle as others leave room, on a spiral from there, with a line to it. -->
      <rule key="short" description="short" filter="ELSE">
        <settings calloutType="simple">
          <text-style fieldName="'&#8194;' || &quot;lane&quot; || '&#8194;'" isExpression="1" fontSize="7.5" fontSizeUnit="Point" fontFamily="Open Sans" fontWeight="75" namedStyle="Bold" textColor="17,24,39,255" textOpacity="1">
            <text-buffer bufferDraw="1" bufferSize="0.7" bufferSizeUnits="MM" bufferColor="255,255,255,255" bufferOpacity="0.92" bufferJoinStyle="128" />
          </text-style>
          <placement placement="4" placementFlags="9" dist="0" distUnits="MM" lineAnchorPercent="0" lineAnchorType="0" lineAnchorClipping="0" priority="9" overlapHandling="AllowOverlapIfRequired" allowDegraded="1" geometryGeneratorEnabled="1" geometryGeneratorType="LineGeometry" geometryGenerator="with_variable('mm', coalesce(@map_scale, 1000) / 1000 * if(@map_crs = 'EPSG:3857', coalesce(try(sqrt(area(transform(@map_extent, @map_crs, @layer_crs)) / area(@map_extent))), 1), 1), with_variable('seen', try(intersection($geometry, if(@map_crs = @layer_crs, @map_extent, transform(@map_extent, @map_crs, @layer_crs)))), with_variable('lane', if(is_empty_or_null(@seen), $geometry, @seen), with_variable('at', closest_point(@lane, centroid(@lane)), make_line(array_foreach(generate_series(0, 35), make_point(x(@at) + 0.4 * @element * @mm * cos(0.7 * @element), y(@at) + 0.32 * @element * @mm * sin(0.7 * @element))))))))" />
          <rendering drawLabels="1" obstacle="0" scaleVisibility="0" labelPerPart="0" mergeLines="0" minFeatureSize="0" limitNumLabels="0" upsidedownLabels="0" unplacedVisibility="0" />
          <callout type="simple">
            <Option type="Map">
              <Option name="enabled" type="QString" value="1" />
              <Option name="labelAnchorPoint" type="QString" value="point_on_exterior" />
              <Option name="minLength" type="double" value="0.6" />
              <Option name="minLengthUnit" type="QString" value="MM" />
              <Option name="offsetFromLabel" type="double" value="0.2" />
              <Option name="offsetFromLabelUnit" type="QString" value="MM" />
              <Option name="lineSymbol" type="QString" value="&lt;symbol type=&quot;line&quot; name=&quot;symbol&quot; alpha=&quot;1&quot; clip_to_extent=&quot;1&quot; force_rhr=&quot;0&quot;&gt;&lt;layer class=&quot;SimpleLine&quot; enabled=&quot;1&quot; pass=&quot;0&quot;&gt;&lt;Option type=&quot;Map&quot;&gt;&lt;Option name=&quot;line_color&quot; type=&quot;QString&quot; value=&quot;17,24,39,200&quot; /&gt;&lt;Option name=&quot;line_width&quot; type=&quot;QString&quot; value=&quot;0.15&quot; /&gt;&lt;Option name=&quot;line_width_unit&quot; type=&quot;QString&quot; value=&quot;MM&quot; /&gt;&lt;/Option&gt;&lt;/layer&gt;&lt;/symbol&gt;" />
              <Option name="ddProperties" type="Map">
                <Option name="properties" type="Map">
                  <Option name="DestinationX" type="Map">
                    <Option name="active" type="bool" value="true" />
                    <Option name="expression" type="QString" value="x(start_point($geometry))" />
                    <Option name="type" type="int" value="3" />
                  </Option>
                  <Option name="DestinationY" type="Map">
                    <Option name="active" type="bool" value="true" />
                    <Option name="expression" type="QString" value="y(start_point($geometry))" />
                    <Option name="type" type="int" value="3" />
                  </Option>
                </Option>
                <Option name="type" type="QString" value="collection" />
              </Option>
            </Option>
          </callout>
        </settings>
      </rule>
    </rules>
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
    <alias index="9" field="speed_limit_kmh" name="Speed limit (km/h)" />
  </aliases>
  <previewExpression>"lane"</previewExpression>
  <!-- Texts of the file are shown as text: QGIS takes a tip for HTML. -->
  <mapTip enabled="1">&lt;b&gt;[% replace(replace("lane", '&amp;', '&amp;amp;'), '&lt;', '&amp;lt;') %]&lt;/b&gt;[% coalesce(' ' || replace(replace("street", '&amp;', '&amp;amp;'), '&lt;', '&amp;lt;'), '') %][% coalesce(' (' || replace(replace("street_part", '&amp;', '&amp;amp;'), '&lt;', '&amp;lt;') || ')', '') %]&lt;br&gt;[% replace(replace("direction", '&amp;', '&amp;amp;'), '&lt;', '&amp;lt;') %][% coalesce(', ' || replace(replace("turn", '&amp;', '&amp;amp;'), '&lt;', '&amp;lt;'), '') %], [% format_number("length_m", 0) %] m</mapTip>
  <layerGeometryType>1</layerGeometryType>
</qgis>
