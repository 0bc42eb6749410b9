-- Which values changed between two versions over the same scans, and by how much against U? The variables version_a and
-- version_b name the versions: a code version, a configuration's fingerprint, a commit (or its beginning), or `current`.
-- Where a version made a scan's values more than once, its last counts. A scan whose table came out the same to the byte was
-- never superseded: it belongs to the later version alone and is not listed.
--
-- Columns
-- scan_id: scan bundle
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- old_value: value of version A, in unit
-- new_value: value of version B, in unit
-- unit: unit of the values
-- change: new less old, in unit
-- expanded_uncertainty: larger of the two stated U
-- change_ratio: size of the change over it
-- old_expanded_uncertainty: U stated by version A
-- new_expanded_uncertainty: U stated by version B
-- what: changed, same, lost (a value in A only), gained (in B only), or reason changed
-- old_reason: why A gave no value
-- new_reason: why B gave no value
WITH made AS (
    SELECT DISTINCT
        scan_id,
        output_version,
        code_version,
        config_fingerprint,
        coalesce(git_commit, '') AS git_commit,
        superseded_at,
        produced_at
    FROM lineage
    WHERE output_name = 'measurements'
),

named AS (
    SELECT made.*, side_of, version
    FROM made, (VALUES ('a', getvariable('version_a')::VARCHAR), ('b', getvariable('version_b')::VARCHAR)) AS asked (side_of, version)
    WHERE (version = 'current' AND superseded_at IS NULL)
        OR code_version = version
        OR starts_with(config_fingerprint, version)
        OR (length(version) >= 4 AND starts_with(git_commit, version))
        OR output_version = version
),

chosen AS (
    SELECT *
    FROM named
    QUALIFY row_number() OVER (PARTITION BY side_of, scan_id ORDER BY produced_at DESC, output_version) = 1
),

both_sides AS (
    SELECT scan_id FROM chosen GROUP BY scan_id HAVING count(*) = 2
),

rows_of AS (
    SELECT
        scan_id, quantity, side, wheelset_id, value, unit, expanded_uncertainty, reason, NULL AS output_version
    FROM measurements
    UNION ALL
    SELECT
        scan_id, quantity, side, wheelset_id, value, unit, expanded_uncertainty, reason, output_version
    FROM measurements_history
),

picked AS (
    SELECT chosen.side_of, rows_of.*
    FROM rows_of
    INNER JOIN chosen
        ON chosen.scan_id = rows_of.scan_id
        AND (
            (chosen.superseded_at IS NULL AND rows_of.output_version IS NULL)
            OR (chosen.superseded_at IS NOT NULL AND rows_of.output_version = chosen.output_version)
        )
    WHERE rows_of.scan_id IN (SELECT scan_id FROM both_sides)
),

pairs AS (
    SELECT
        coalesce(old.scan_id, new.scan_id) AS scan_id,
        coalesce(old.wheelset_id, new.wheelset_id) AS wheelset_id,
        coalesce(old.quantity, new.quantity) AS quantity,
        coalesce(old.side, new.side) AS side,
        old.value AS old_value,
        new.value AS new_value,
        coalesce(new.unit, old.unit) AS unit,
        new.value - old.value AS change,
        greatest(old.expanded_uncertainty, new.expanded_uncertainty) AS expanded_uncertainty,
        abs(new.value - old.value) / nullif(greatest(old.expanded_uncertainty, new.expanded_uncertainty), 0)
            AS change_ratio,
        old.expanded_uncertainty AS old_expanded_uncertainty,
        new.expanded_uncertainty AS new_expanded_uncertainty,
        old.reason AS old_reason,
        new.reason AS new_reason
    FROM (FROM picked WHERE side_of = 'a') AS old
    FULL JOIN (FROM picked WHERE side_of = 'b') AS new
        ON new.scan_id = old.scan_id AND new.quantity = old.quantity AND new.side = old.side
)

SELECT
    scan_id,
    wheelset_id,
    quantity,
    side,
    old_value,
    new_value,
    unit,
    change,
    expanded_uncertainty,
    change_ratio,
    old_expanded_uncertainty,
    new_expanded_uncertainty,
    CASE
        WHEN old_value IS NULL AND new_value IS NOT NULL THEN 'gained'
        WHEN old_value IS NOT NULL AND new_value IS NULL THEN 'lost'
        WHEN change <> 0 OR old_expanded_uncertainty <> new_expanded_uncertainty THEN 'changed'
        WHEN old_reason IS DISTINCT FROM new_reason THEN 'reason changed'
        ELSE 'same'
    END AS what,
    old_reason,
    new_reason
FROM pairs
ORDER BY change_ratio DESC NULLS LAST, scan_id, quantity_order(quantity), quantity, side
