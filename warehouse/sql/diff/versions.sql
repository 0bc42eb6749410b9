-- Which versions of code and configuration made measurements, current ones and those that were superseded? A version is
-- named by its code version, its configuration's fingerprint, or the commit of the program.
--
-- Columns
-- code_version: version of the stage and its tables
-- config_fingerprint: fingerprint of its configuration
-- git_commit: commit of the program
-- n_scans: scans
-- n_current: scans of which it made the current values
-- first_at: when the first of them was made
-- last_at: when the last was made
SELECT
    code_version,
    config_fingerprint,
    git_commit,
    count(DISTINCT scan_id) AS n_scans,
    count(DISTINCT scan_id) FILTER (WHERE superseded_at IS NULL) AS n_current,
    min(produced_at) AS first_at,
    max(produced_at) AS last_at
FROM lineage
WHERE output_name = 'measurements'
GROUP BY code_version, config_fingerprint, git_commit
ORDER BY first_at, code_version, config_fingerprint, git_commit
