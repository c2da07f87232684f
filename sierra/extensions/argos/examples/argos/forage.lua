-- Forage: search food at random, carry it towards the light into the nest, and avoid walls and other robots.
-- Each robot writes its data into a file of its own, such as fb0.csv, in the folder in which ARGoS was started.

local EVERY = 10 -- ticks between two rows

local speed, nest, food -- parameters of the template: cm/s, m, m
local file
local tick, turn = 0, 0 -- turn: ticks left of a turn to the left; negative: to the right
local carries, collected, avoided = 0, 0, 0

-- ARGoS calls init before the first tick, when sensors have no readings yet.
function init()
   speed = assert(tonumber(robot.params.speed), "speed is not a number")
   nest = assert(tonumber(robot.params.nest), "nest is not a number")
   food = assert(tonumber(robot.params.food), "food is not a number")
   file = assert(io.open(robot.id .. ".csv", "w"))
   file:write("tick,x,y,carries,collected,avoided\n")
end

-- ARGoS calls step in each tick.
function step()
   tick = tick + 1
   local position = robot.positioning.position
   if carries == 0 and position.x > food then
      carries = 1
   elseif carries == 1 and position.x < nest then
      carries, collected = 0, collected + 1
   end
   if turn == 0 then
      turn = choose_turn()
   end
   drive()
   if tick % EVERY == 0 then
      file:write(string.format("%d,%.6f,%.6f,%d,%d,%d\n", tick, position.x, position.y, carries, collected, avoided))
   end
end

function reset()
end

-- ARGoS calls destroy after the last tick.
function destroy()
   file:close()
end

-- Return the ticks of the next turn: away from an obstacle, else with food towards the light, else at random.
function choose_turn()
   local ahead, left = direction(robot.proximity)
   if ahead > 0.1 then
      avoided = avoided + 1
      local ticks = robot.random.uniform_int(2, 9)
      return left > 0 and -ticks or ticks
   end
   if carries == 1 then
      ahead, left = direction(robot.light)
      if ahead > 0 and math.abs(left) < 0.3 * ahead then
         return 0
      end
      return left > 0 and 1 or -1
   end
   return robot.random.bernoulli(0.05) and robot.random.uniform_int(-5, 6) or 0
end

-- Return the sum of the readings around the robot as a vector: its parts ahead and to the left.
function direction(readings)
   local ahead, left = 0, 0
   for i = 1, #readings do
      ahead = ahead + readings[i].value * math.cos(readings[i].angle)
      left = left + readings[i].value * math.sin(readings[i].angle)
   end
   return ahead, left
end

-- Turn on the spot, or drive on.
function drive()
   if turn > 0 then
      robot.wheels.set_velocity(-speed, speed)
      turn = turn - 1
   elseif turn < 0 then
      robot.wheels.set_velocity(speed, -speed)
      turn = turn + 1
   else
      robot.wheels.set_velocity(speed, speed)
   end
end
