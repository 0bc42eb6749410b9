-- As of which day does the fleet report speak? The day given as `until`; else the last day on which anything was scanned.
-- "This week" are the seven days that follow it.
--
-- Columns
-- as_of: the report's day
-- week_ends_on: seven days later
-- n_wheelsets: wheelsets with a production value up to then
-- n_scans: production scans with a value
-- first_on: first day with a value
-- last_on: last day with a value
WITH known AS (
    SELECT
        count(DISTINCT wheelset_id) FILTER (WHERE value IS NOT NULL) AS n_wheelsets,
        count(DISTINCT scan_id) FILTER (WHERE value IS NOT NULL) AS n_scans,
        min(acquired_on) FILTER (WHERE value IS NOT NULL) AS first_on,
        max(acquired_on) FILTER (WHERE value IS NOT NULL) AS last_on
    FROM service_values
),

scans AS (SELECT max(acquired_on) AS last_scan_on FROM scan_status),

days AS (
    SELECT
        known.*,
        coalesce(getvariable('until')::DATE, greatest(known.last_on, scans.last_scan_on)) AS as_of
    FROM known, scans
)

SELECT
    as_of,
    as_of + 7 AS week_ends_on,
    n_wheelsets,
    n_scans,
    first_on,
    last_on
FROM days
WHERE as_of IS NOT NULL
