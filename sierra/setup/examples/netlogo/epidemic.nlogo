turtles-own [ infected? ]

to setup
  clear-all
  create-turtles people [
    setxy random-xcor random-ycor
    set infected? false
  ]
  ask n-of 1 turtles [ set infected? true ]
  reset-ticks
end

to go
  ask turtles [
    right random 50
    left random 50
    forward 1
  ]
  ask turtles with [ infected? ] [
    ask turtles-here with [ not infected? ] [
      if random-float 1 < infectiousness [ set infected? true ]
    ]
  ]
  tick
end

to-report share-infected
  report count turtles with [ infected? ] / count turtles
end
@#$#@#$#@
GRAPHICS-WINDOW
210
10
647
448
-1
-1
13.0
1
10
1
1
1
0
1
1
1
-16
16
-16
16
0
0
1
ticks
30.0

SLIDER
20
20
192
53
people
people
1
1000
100.0
1
1
NIL
HORIZONTAL

SLIDER
20
60
192
93
infectiousness
infectiousness
0
1
0.5
0.01
1
NIL
HORIZONTAL

BUTTON
20
100
93
133
NIL
setup
NIL
1
T
OBSERVER
NIL
NIL
NIL
NIL
1

BUTTON
120
100
183
133
NIL
go
T
1
T
OBSERVER
NIL
NIL
NIL
NIL
0

@#$#@#$#@
People walk at random, and infect each other where they meet.
@#$#@#$#@
default
true
0
Polygon -7500403 true true 150 5 40 250 150 205 260 250
@#$#@#$#@
NetLogo 6.4.0
@#$#@#$#@
@#$#@#$#@
@#$#@#$#@
@#$#@#$#@
@#$#@#$#@
default
0.0
-0.2 0 0.0 1.0
0.0 1 1.0 0.0
0.2 0 0.0 1.0
link direction
true
0
Line -7500403 true 150 150 90 180
Line -7500403 true 150 150 210 180
@#$#@#$#@
0
@#$#@#$#@
