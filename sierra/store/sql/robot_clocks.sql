-- Lines through the offsets of robots' clocks. Old rows have no `uneven_ns`. Their clocks were not watched, and the whole change
-- of an offset may have come at once.
SELECT execution, place, clock_start_ns AS clock_ns, offset_start_ns AS offset_ns,
       CASE WHEN clock_remark IS NULL THEN (offset_end_ns - offset_start_ns) / nullif(clock_end_ns - clock_start_ns, 0) END
           AS drift,
       rtt_ns / 2 + coalesce(uneven_ns, abs(offset_end_ns - offset_start_ns)) AS uncertainty_ns, clock_remark AS remark
FROM robots WHERE offset_start_ns IS NOT NULL AND clock_start_ns IS NOT NULL
