/* Delays of messages from each robot to the base station. A robot stamps a message by its own clock, and the base station
   receives it by its own; both are brought to the time axis of the host that started the run. Messages of robots whose clocks were
   set during the run count nowhere. */
WITH messages AS (
    SELECT execution, replace(child_frame_id, 'robot', '')::INT AS robot, header_stamp_ns AS sent, received_ns AS received
    FROM heard
), common AS (
    SELECT robot,
        sent - r.offset_ns - round(r.drift * (sent - r.clock_ns))::BIGINT AS sent_ns,
        received - b.offset_ns - round(b.drift * (received - b.clock_ns))::BIGINT AS received_ns,
        r.uncertainty_ns + b.uncertainty_ns AS uncertainty_ns
    FROM messages
    JOIN robot_clocks r ON r.execution = messages.execution AND r.place = messages.robot
    JOIN robot_clocks b ON b.execution = messages.execution AND b.place = 0
)
SELECT robot, count(received_ns - sent_ns) AS messages, median(received_ns - sent_ns) / 1e6 AS delay_ms,
    max(uncertainty_ns) / 1e6 AS uncertainty_ms
FROM common GROUP BY robot ORDER BY robot
