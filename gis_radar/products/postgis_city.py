"""A city in PostGIS: a schema a site, and one whose views hold all sites with a column `site`.

A site is published in a transaction of its own, several side by side, so that one that fails stops
no other. Programs open the views, of which there are as many for one site as for two hundred.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gis_radar.base import (
    QUIET,
    GisRadarError,
    InputError,
    OutputError,
    Reporter,
    watch_parent,
    worker_pool,
    workers_here,
)
from gis_radar.dataset import site_folders, warn_of_copies
from gis_radar.products.postgis import (
    MARK,
    PUBLISHED_VIEWS,
    VERSION,
    Publication,
    Session,
    opened_session,
    publish,
    require_name,
)

_VIEWS = {name: comment for name, (_, comment) in PUBLISHED_VIEWS.items()} | {
    "tiles": "Tiles of all sites", "lanes": "Lanes of all sites", "sensors": "Radars of all sites",
    "tile_counts": "Steps of 50 ms of a tile in a quarter of an hour",
    "lane_measures": "Traffic of a lane in a quarter of an hour",
    "turns": "Traffic from lane to lane in a quarter of an hour",
    "publication": "Dates that are published",
}  # fmt: skip
_MOST_AT_ONCE = 8  # sites, with a connection each: a database takes 100 by default
_LONGEST = 63  # bytes of a name in PostgreSQL


@dataclass(frozen=True, kw_only=True)
class CityPublication:
    """Result of the publication of a city.

    Parameters
    ----------
    schema : str
        Schema of the views of all sites.
    sites : dict
        Publication of each site.
    """

    schema: str
    sites: Mapping[str, Publication]

    def figures(self) -> dict[str, Any]:
        """Return the figures of the result by name."""
        sums: Counter[str] = Counter()
        for each in self.sites.values():
            sums.update({k: n for k, n in each.figures().items() if isinstance(n, int)})
        return {"sites_published": len(self.sites), "schema": self.schema, **sums}


def is_city(root: str | Path) -> bool:
    """Return whether a folder holds datasets of sites, `ROOT/site=NAME/`."""
    return bool(site_folders(Path(root)))


def publish_city(
    root: str | Path, url: str, *, schema: str = "gis_radar", reader: str | None = None,
    reporter: Reporter = QUIET,
) -> CityPublication:  # fmt: skip
    """Publish the datasets of all sites of a city in PostGIS; only what changed is sent.

    Site NAME is published as :func:`gis_radar.publish` does, in the schema `SCHEMA_NAME`. Views in
    SCHEMA hold the rows of all sites, with a column `site`, in the coordinate system of most.

    Parameters
    ----------
    root : str or Path
        A folder with a dataset a site, `ROOT/site=NAME/`.
    url, reader
        As for :func:`gis_radar.publish`.
    schema : str
        Schema of the views, and the beginning of those of the sites.
    reporter : Reporter
        Receives the progress, and a warning for each site that fails or has recordings of another.

    Returns
    -------
    CityPublication

    Raises
    ------
    InputError
        If there is no site, or two are one folder or have one name in the database.
    OutputError
        If the database cannot be reached, or SCHEMA holds something else; then nothing is sent. If
        sites failed, which stay as they were; the others are published.
    """
    require_name(schema)
    places = site_folders(Path(root))
    if not places:
        raise InputError("{}: has no dataset {}", root, "site=NAME/")
    schemas = _schemas(Path(root), list(places), schema)
    warn_of_copies(places, reporter)
    with opened_session(url, schema) as session:
        session.prepare_extension()  # not by several sites at once
        session.prepare_schema(f"{MARK} a city of version {VERSION}")
    published, failed = dict[str, Publication](), dict[str, GisRadarError]()
    reporter.progress("publishing sites", 0, len(places))
    with worker_pool(min(workers_here(), len(places), _MOST_AT_ONCE), watch_parent) as pool:
        running = {
            pool.submit(
                publish, folder, url, schema=schemas[name], reader=reader, notify=False
            ): name
            for name, folder in places.items()
        }
        for done, each in enumerate(as_completed(running), start=1):
            name = running[each]
            try:
                published[name] = each.result()
            except GisRadarError as error:
                failed[name] = error
                reporter.warn("site {}: {}", name, error.message)
            reporter.progress("publishing sites", done, len(places))
    published = {name: published[name] for name in places if name in published}
    with opened_session(url, schema) as session:
        _make_views(session, schemas)
        session.grant(reader)
        session.notify(schema)  # first: QGIS takes one message a second
        for name, sent in published.items():
            if sent.sent or sent.removed:
                session.notify(schemas[name])
    if failed:
        raise OutputError(
            "{} of {} sites were not published: {}", len(failed), len(places),
            ", ".join(sorted(failed)), hint="the others were",
        )  # fmt: skip
    return CityPublication(schema=schema, sites=published)


def _schemas(root: Path, names: list[str], schema: str) -> dict[str, str]:
    """Return the schema of each site: its name in small letters without accents."""
    schemas: dict[str, str] = {}
    for name in names:
        plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode().lower()
        own_schema = f"{schema}_{re.sub('[^a-z0-9]+', '_', plain).strip('_')}"
        if (
            own_schema in schemas.values()
            or len(own_schema) > _LONGEST
            or own_schema == f"{schema}_"
        ):
            raise InputError(
                "{}: site {} would be in schema {}, which is another's or no name",
                root, name, own_schema, hint="rename the folder of the site",
            )  # fmt: skip
        schemas[name] = own_schema
    return schemas


def _make_views(session: Session, schemas: Mapping[str, str]) -> None:
    """Make a view of each table over all sites that have it."""
    from psycopg import errors  # noqa: PLC0415 - an extra

    for view, comment in _VIEWS.items():
        columns = {
            site: found for site, own in schemas.items() if (found := session.columns(own, view))
        }
        if not columns:
            continue
        rows = _union(session, view, columns, schemas)
        statement = f"CREATE OR REPLACE VIEW {{schema}}.{{view}} AS {rows}"
        try:
            with session.cursor.connection.transaction():
                session.run(statement, view=view)
        except errors.InvalidTableDefinition:  # a column is gone, or has another type
            session.run("DROP VIEW {schema}.{view}", view=view)
            session.run(statement, view=view)
        session.run("COMMENT ON VIEW {schema}.{view} IS {text}", text=comment, view=view)


def _union(
    session: Session, view: str, columns: Mapping[str, Mapping[str, str]],
    schemas: Mapping[str, str],
) -> str:  # fmt: skip
    """Return the rows of all sites as SQL: the columns that all have, each of its usual type."""
    first, *others = columns.values()
    names = [name for name in first if all(name in each for each in others)]
    usual_types = {name: Counter(each[name] for each in columns.values()).most_common(1)[0][0]
             for name in names}  # fmt: skip
    parts = []
    for site, columns_of_site in columns.items():
        shown = [_shown(name, columns_of_site[name], usual_types[name]) for name in names]
        site_column = session.quoted("SELECT {text}::text AS site", text=site)
        source = session.quoted("{own}.{view}", own=schemas[site], view=view)
        parts.append(f"{site_column}, {', '.join(shown)} FROM {source}")
    return " UNION ALL ".join(parts).replace("{", "{{").replace("}", "}}")


def _shown(name: str, kind: str, usual: str) -> str:
    """Return a column as SQL, converted where it is not of the usual type."""
    column = '"' + name.replace('"', '""') + '"'
    if kind == usual:
        return column
    if not usual.startswith("geometry("):
        return f"{column}::{usual} AS {column}"
    shape, srid = usual.removeprefix("geometry(").removesuffix(")").split(",")
    flat = "ST_Force3D" if shape.endswith("Z") else "ST_Force2D"
    return f"ST_Transform({flat}({column}), {int(srid)})::{usual} AS {column}"
